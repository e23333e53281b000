const SIGNALS = ["#e0202c", "#f0a800", "#18a04a"], UNREPORTED = "#98a4b0", BAND = "#e4e9ee", BORDER = "#ffffff";

function drawRoad(g, road, k, thin) {  // lanes as bands, stop lines and lights in the colour last reported
  const strip = (values, from) => {
    g.beginPath();
    for (let i = from; i < values.length; i += 2) g.lineTo(values[i] / 100, values[i + 1] / 100);
    g.stroke();
  };
  const colourOf = light => SIGNALS[road.colours[k][light]] ?? UNREPORTED;
  g.save();
  g.lineJoin = "round";
  for (const lane of road.lanes) {
    const width = lane[0] / 100;
    g.strokeStyle = BORDER; g.lineWidth = width; strip(lane, 1);
    g.strokeStyle = BAND; g.lineWidth = Math.max(0, width - Math.max(.15, 1.5 * thin)); strip(lane, 1);
  }
  for (const line of road.lines) { g.strokeStyle = colourOf(line[0]); g.lineWidth = Math.max(.5, 3 * thin); strip(line, 1); }
  road.lights.forEach(([x, y], light) => {
    g.fillStyle = colourOf(light); g.strokeStyle = "#1d2733"; g.lineWidth = 1.5 * thin;
    g.beginPath(); g.arc(x / 100, y / 100, Math.max(.6, 4 * thin), 0, 7); g.fill(); g.stroke();
  });
  g.restore();
}

const AREAS = {drivable: "#eceff2", crossing: "#dfe6d8", walkway: "#f1ede4"};

function drawMap({g, scene, thin}) {  // areas, and lines of lanes, from the map of the recordings
  for (const [kind, ...rings] of scene.map.areas) {
    g.fillStyle = AREAS[kind];
    g.beginPath();
    for (const ring of rings) {
      for (let i = 0; i < ring.length; i += 2) g[i ? "lineTo" : "moveTo"](ring[i] / 100, ring[i + 1] / 100);
      g.closePath();
    }
    g.fill("evenodd");
  }
  g.strokeStyle = "#cdd5dc"; g.lineWidth = thin;
  for (const line of scene.map.lines) {
    g.beginPath();
    for (let i = 0; i < line.length; i += 2) g.lineTo(line[i] / 100, line[i + 1] / 100);
    g.stroke();
  }
}
