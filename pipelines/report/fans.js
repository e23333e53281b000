// The layer of predictions, and the switches of its horizons.
const FAN_MOVING = 50;  // cm/s, from which a track has a fan while none is followed
const FAN_HORIZON = 1, FAN_X = 2, FAN_Y = 3, FAN_XX = 4, FAN_XY = 5, FAN_YY = 6, FAN_MODE = 7, FAN_SHARE = 8;
const horizonsOff = new Set();  // ms

function fansOf({k, result, tracks, focus}) {  // of the followed track, else of all that move or have modes: [track, mode, rows]
  const rows = (result.predictions[k] ?? []).filter(row => !horizonsOff.has(row[FAN_HORIZON])), fans = [];
  for (const track of focus ? [focus] : tracks) {
    const own = rows.filter(row => row[ID] === track[ID]), modes = new Set(own.map(row => row[FAN_MODE]).filter(mode => mode));
    if (track !== focus && !modes.size && Math.hypot(track[VX], track[VY]) < FAN_MOVING) continue;
    for (const mode of modes.size ? modes : [0]) fans.push([track, result.modes[mode], own.filter(row => row[FAN_MODE] === mode)]);
  }
  return fans;
}

const shareOf = row => `${Math.round(row[FAN_SHARE] / 10)} %`;

function modeAt(view, p) {  // the mode whose ellipse holds a point, the nearest one; "" where there is none
  let near = Infinity, text = "";
  for (const [track, mode, fan] of view.fans) for (const row of mode ? fan : []) {
    if (row[FAN_XX] === null) continue;
    const dx = p.x - row[FAN_X] / 100, dy = p.y - row[FAN_Y] / 100, [a, b, turn] = ellipse(row[FAN_XX] / 1e4, row[FAN_XY] / 1e4, row[FAN_YY] / 1e4);
    const c = Math.cos(turn), s = Math.sin(turn), apart = Math.hypot(dx, dy);
    if (((c * dx + s * dy) / a) ** 2 + ((c * dy - s * dx) / b) ** 2 > 1 || apart >= near) continue;
    near = apart;
    text = `track ${shortName(view.result.ids[track[ID]])} ${mode}: ${shareOf(row)}, in ${row[FAN_HORIZON] / 1000} s`;
  }
  return text;
}

function drawFans(view) {  // a line of means, an ellipse at each horizon; of hidden tracks one for each mode, the likelier the stronger
  const {g, thin} = view;
  g.lineWidth = 1.2 * thin;
  view.fans = fansOf(view);
  for (const [track, mode, fan] of view.fans) {
    const colour = view.colour(track);
    g.strokeStyle = g.fillStyle = colour;
    g.globalAlpha = .7;
    g.setLineDash([2 * thin, 3 * thin]);
    g.beginPath(); g.moveTo(...middle(track));
    for (const row of fan) g.lineTo(row[FAN_X] / 100, row[FAN_Y] / 100);
    g.stroke();
    g.setLineDash([]);
    for (const row of fan) {
      const place = [row[FAN_X] / 100, row[FAN_Y] / 100], share = row[FAN_SHARE] / 1000;
      g.globalAlpha = .7 * share; g.beginPath(); g.arc(...place, 2 * thin, 0, 7); g.fill();
      if (row[FAN_XX] === null) continue;
      g.beginPath(); g.ellipse(...place, ...ellipse(row[FAN_XX] / 1e4, row[FAN_XY] / 1e4, row[FAN_YY] / 1e4), 0, 7);
      g.globalAlpha = mode ? .3 * share : .08; g.fill();
      g.globalAlpha = mode ? .1 + .9 * share : .5; g.stroke();
    }
    if (mode && fan.length) {
      const end = fan[fan.length - 1];
      view.names.push({at: [end[FAN_X] / 100, end[FAN_Y] / 100], text: `${shortName(view.result.ids[track[ID]])} ${mode} ${shareOf(end)}`, colour});
    }
  }
}

function showHorizons(results, changed) {  // a switch for each horizon of the results that are shown
  const horizons = [...new Set(results.flatMap(result => result.horizons))].sort((a, b) => a - b);
  $("horizons").replaceChildren(...horizons.map(horizon => {
    const label = document.createElement("label"), input = document.createElement("input");
    input.type = "checkbox"; input.checked = !horizonsOff.has(horizon); input.id = `horizon-${horizon}`;
    input.onchange = () => { input.checked ? horizonsOff.delete(horizon) : horizonsOff.add(horizon); changed(); };
    label.append(input, ` ${horizon / 1000} s ahead`);
    return label;
  }));
}
