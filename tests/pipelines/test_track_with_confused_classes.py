"""Two sensors that mistake cars, trucks and buses for one another: what beliefs over classes are worth."""

from dataclasses import replace

from benchmarks.variants import changed
from data_tools.metrics import SceneMetrics, scene_metrics
from data_tools.simulator import SimulatorSettings, simulate_scene
from pipelines.config import load_config
from pipelines.tracking import track_scene

RIGHT = {"lidar": 0.9, "camera": 0.7}
VEHICLES = ("car", "truck", "bus")


def test_beliefs_over_classes_leave_one_track_an_object():
    plain = load_config("simulated")
    believing = changed(plain, "tracker.class_groups", (VEHICLES,))
    simulator = SimulatorSettings(duration=4.0)
    sensors = simulator.sensors
    for name, share in RIGHT.items():
        believing = changed(believing, f"sensors.{name}.class_accuracy", share)
        sensors = {**sensors, name: replace(sensors[name], class_accuracy=share)}
    scene = simulate_scene(replace(simulator, sensors=sensors), seed=702)
    assert scene.ground_truth is not None
    runs = {}
    for name, config in (("plain", plain), ("believing", believing)):
        tracks = track_scene(scene, config.new_tracker("saga")).tracks
        vehicles = {id_ for each in tracks for id_ in each.id[each.boxes.label != "pedestrian"].tolist()}
        runs[name] = SceneMetrics.pool([scene_metrics(scene.ground_truth, tracks)]).mota, len(vehicles)
    assert runs["believing"][0] > runs["plain"][0] + 0.3
    assert runs["believing"][1] < 0.75 * runs["plain"][1]
