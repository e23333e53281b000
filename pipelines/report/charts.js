let COLOURS, colourOf;  // of tracks in turn, and by the names of classes and series: those of all pictures

function svg(name, attributes, text) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  if (text !== undefined) element.textContent = text;
  return element;
}

function niceStep(range, wanted) {
  const raw = range / wanted, power = 10 ** Math.floor(Math.log10(raw));
  return [1, 2, 5, 10].map(m => m * power).find(step => step >= raw);
}

function drawChart(chart) {
  const W = 460, H = 270, left = 48, right = 12, top = 10, bottom = 40;
  const xs = chart.series.flatMap(s => s.x), ys = chart.series.flatMap(s => s.y);
  const xMax = Math.max(...xs) || 1, most = Math.max(...ys) || 1, yMax = most > .9 && most < 1 ? 1 : most;
  const px = x => left + (x / xMax) * (W - left - right), py = y => H - bottom - (y / yMax) * (H - top - bottom);
  const figure = document.createElement("figure"), caption = document.createElement("figcaption");
  caption.textContent = chart.title;
  const plot = svg("svg", {viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": chart.title});
  const axis = (max, wanted, line) => {
    const step = niceStep(max, wanted);
    for (let k = 0; k * step <= max * 1.0001; k++) line(k * step, +(k * step).toPrecision(3));
  };
  axis(xMax, 6, (v, text) => plot.append(
    svg("line", {x1: px(v), x2: px(v), y1: top, y2: H - bottom, stroke: "#e8edf1"}),
    svg("text", {x: px(v), y: H - bottom + 15, "text-anchor": "middle"}, text)));
  axis(yMax, 5, (v, text) => plot.append(
    svg("line", {x1: left, x2: W - right, y1: py(v), y2: py(v), stroke: "#e8edf1"}),
    svg("text", {x: left - 6, y: py(v) + 4, "text-anchor": "end"}, text)));
  plot.append(
    svg("text", {x: (left + W - right) / 2, y: H - 8, "text-anchor": "middle"}, chart.x_label),
    svg("text", {x: 12, y: (top + H - bottom) / 2, "text-anchor": "middle", transform: `rotate(-90 12 ${(top + H - bottom) / 2})`}, chart.y_label));
  chart.series.forEach(s => {
    if (chart.bars) {
      s.y.forEach((y, k) => plot.append(svg("rect", {x: px(s.x[k]), y: py(y), width: Math.max(px(s.x[k + 1]) - px(s.x[k]) - 1, .5), height: py(0) - py(y), fill: COLOURS[0]})));
      return;
    }
    const stroke = s.faint ? "#aab4be" : colourOf[s.name];
    plot.append(svg("polyline", {points: s.x.map((x, k) => `${px(x).toFixed(1)},${py(s.y[k]).toFixed(1)}`).join(" "), fill: "none", stroke, "stroke-width": s.faint ? 1 : 2, "stroke-dasharray": s.faint ? "4 4" : "none"}));
    if (!s.faint) plot.append(svg("text", {x: W - right - 4, y: H - bottom - 8 - 14 * (chart.series.length - 1 - chart.series.indexOf(s)), "text-anchor": "end", style: `fill:${stroke};font-weight:600`}, s.name));
  });
  figure.append(caption, plot);
  return figure;
}
