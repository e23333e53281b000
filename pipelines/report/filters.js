// The rows that are shown, and the controls that choose them: classes, scores, confirmed, ghosts.
const CONFIRMED = 3;  // moments at which a track was detected

function makeFilters(scenes, thresholds, ghosts, changed, chosen) {  // chosen: one class alone, or all again
  const state = {confirmed: true, ghosts, byTrack: false, off: new Set(), thresholds: {...thresholds}};
  const counted = new Map(), means = new Map(), classColour = label => colourOf[label] ?? SOFT;  // a correction may bring a new class

  function detectedMoments(result) {  // of each track of a result
    if (!counted.has(result)) {
      const counts = new Int32Array(result.ids.length);
      for (const rows of result.moments) for (const row of rows) if (!(row[COASTING] > unseenFrom)) counts[row[ID]]++;
      counted.set(result, counts);
    }
    return counted.get(result);
  }

  function meanScores(result) {  // of each track, in thousandths: evaluations rank tracks by them
    if (!means.has(result)) {
      const sums = new Float64Array(result.ids.length), counts = new Float64Array(result.ids.length);
      for (const rows of result.moments) for (const row of rows) { sums[row[ID]] += row[SCORE]; counts[row[ID]]++; }
      means.set(result, sums.map((sum, id) => sum / counts[id]));
    }
    return means.get(result);
  }

  const shownClass = (scene, label) => !state.off.has(scene.labels[label]);

  function rows(scene, name, k, followed) {
    const result = scene.methods[name], counts = detectedMoments(result), score = meanScores(result), least = 1000 * state.thresholds[name];
    return result.moments[k].filter(row => row[ID] === followed || (score[row[ID]] >= least && shownClass(scene, row[LABEL])
      && (state.ghosts || !(row[COASTING] > unseenFrom)) && (!state.confirmed || counts[row[ID]] >= CONFIRMED)));
  }

  const colour = (scene, row) => state.byTrack ? COLOURS[row[ID] % COLOURS.length] : classColour(scene.labels[row[LABEL]]);

  function showClasses(scene) {
    const there = new Set();
    for (const result of Object.values(scene.methods)) for (const moment of result.moments) for (const row of moment) there.add(row[LABEL]);
    for (const moment of scene.truth || []) for (const row of moment) there.add(row[0]);
    $("classes").replaceChildren(...[...there].map(k => scene.labels[k]).sort().map(label => {
      const chip = document.createElement("button");
      chip.type = "button"; chip.className = "chip"; chip.textContent = label; chip.dataset.label = label;
      chip.style.setProperty("--colour", classColour(label));
      chip.setAttribute("aria-pressed", String(!state.off.has(label)));
      chip.title = "click: on and off; double click: this one alone, as near as it fits";
      const press = () => {
        for (const each of $("classes").children) each.setAttribute("aria-pressed", String(!state.off.has(each.dataset.label)));
        changed();
      };
      chip.onclick = () => { state.off.has(label) ? state.off.delete(label) : state.off.add(label); press(); };
      chip.ondblclick = () => {
        const others = [...$("classes").children].map(each => each.dataset.label).filter(each => each !== label);
        const alone = others.every(each => state.off.has(each));
        state.off = new Set(alone ? [] : others); press(); chosen();
      };
      return chip;
    }));
  }

  function showScores(names) {  // a slider for the tracks of each method that is shown
    $("scores").replaceChildren(...names.map((name, at) => {
      const label = document.createElement("label"), input = document.createElement("input"), output = document.createElement("output");
      const scores = scenes.flatMap(scene => scene.methods[name]?.moments.flat().map(row => row[SCORE] / 1000) ?? []);
      const [low, high] = scores.reduce(([a, b], s) => [Math.min(a, s), Math.max(b, s)], [0, 1]);
      Object.assign(input, {type: "range", min: Math.floor(low * 100) / 100, max: Math.ceil(high * 100) / 100, step: .01, id: `score-${at}`});
      input.value = state.thresholds[name];
      const say = () => { output.value = (+input.value).toFixed(2); };
      input.oninput = () => { state.thresholds[name] = +input.value; say(); changed(); };
      say();
      label.append(`mean score${names.length > 1 ? ` of ${name}` : ""} from `, input, output);
      return label;
    }));
  }

  function shift(by) {
    const input = $("score-0");
    input.value = +input.value + by; input.oninput();
  }

  const toggles = [["confirmed", "confirmed only"], ["ghosts", "ghosts (unseen now)"], ["byTrack", "a colour for each track"]];
  return {state, toggles, rows, colour, shownClass, showClasses, showScores, shift};
}
