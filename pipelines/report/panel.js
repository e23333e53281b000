// What is known of the followed track, beside the view.
function describeTrack(panel, scene, result, k, id, colour) {
  const life = result.moments.map(rows => rows.find(row => row[ID] === id)), row = life[k];
  const seen = life.map((r, i) => r ? i : -1).filter(i => i >= 0);
  const speed = r => Math.hypot(r[VX], r[VY]) / 100, facts = [];
  if (row) {
    facts.push(["class", scene.labels[row[LABEL]]], ["score", (row[SCORE] / 1000).toFixed(2)]);
    if (row[VX] !== null) facts.push(["speed", `${speed(row).toFixed(1)} m/s`]);
    if (row[XX] !== null) facts.push(["position ±", `${(Math.sqrt((row[XX] + row[YY]) / 2) / 100).toFixed(2)} m`]);
    if (row[COASTING] !== null) facts.push(["unseen for", `${(row[COASTING] / 1000).toFixed(1)} s`]);
    result.relations.forEach((relation, number) => {
      const others = result.edges[k].filter(e => e[0] === id && e[3] === number).map(e => shortName(result.ids[e[1]]));
      if (others.length) facts.push([relation, others.join(", ")]);
    });
    const modes = new Map();  // the rows of the last horizon come last
    for (const mode of result.predictions[k] ?? []) if (mode[ID] === id && mode[FAN_MODE]) modes.set(mode[FAN_MODE], mode);
    for (const [mode, at] of modes) facts.push([result.modes[mode], `${shareOf(at)}, in ${at[FAN_HORIZON] / 1000} s`]);
  } else facts.push(["now", "not there"]);
  facts.push(["from, to", `${scene.times[seen[0]].toFixed(1)} to ${scene.times[seen[seen.length - 1]].toFixed(1)} s`]);
  const title = document.createElement("h2"), list = document.createElement("dl");
  title.textContent = `track ${result.ids[id]}`; title.style.color = colour;
  for (const [name, value] of facts) {
    const dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = name; dd.textContent = value; list.append(dt, dd);
  }
  const line = (value, name) => sparkline(life.map(r => r ? value(r) : null), k, name, colour);
  panel.replaceChildren(title, list, line(r => r[VX] === null ? null : speed(r), "speed, m/s"), line(r => r[SCORE] / 1000, "score"));
}

function sparkline(values, k, name, colour) {
  const W = 188, H = 44, top = Math.max(...values.map(v => v ?? 0), .01);
  const plot = svg("svg", {viewBox: `0 0 ${W} ${H}`, width: W, height: H, role: "img", "aria-label": name});
  const px = i => i / Math.max(1, values.length - 1) * W, py = v => H - 4 - v / top * (H - 16);
  let path = "";
  values.forEach((v, i) => { if (v !== null) path += `${i && values[i - 1] !== null ? "L" : "M"}${px(i).toFixed(1)} ${py(v).toFixed(1)}`; });
  plot.append(svg("path", {d: path, fill: "none", stroke: colour, "stroke-width": 1.5}),
    svg("line", {x1: px(k), x2: px(k), y1: 12, y2: H, stroke: "#aab4be"}),
    svg("text", {x: 0, y: 9, style: "font-size:10px;fill:#5c6b7a"}, `${name}, up to ${top.toFixed(1)}`));
  return plot;
}
