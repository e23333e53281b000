const FAN_MOVING = 50;  // cm/s, from which a track that is not followed has a fan
const FAN_HORIZON = 1, FAN_X = 2, FAN_Y = 3, FAN_XX = 4, FAN_XY = 5, FAN_YY = 6;

// Where tracks are predicted to be: from each track a line through its means, with an ellipse at every chosen horizon.
// rows: of this moment; chosen: horizons in ms; only: id of the one track that is wanted, null for all that move
function drawFans(g, rows, tracks, chosen, only, thin, colourOf) {
  const now = new Map(tracks.map(row => [row[ID], row])), fans = new Map();
  for (const row of rows) {
    if (!fans.has(row[ID])) fans.set(row[ID], []);
    fans.get(row[ID]).push(row);
  }
  g.save();
  g.lineWidth = 1.2 * thin;
  for (const [id, fan] of fans) {
    const track = now.get(id);
    if (!track || (only === null ? Math.hypot(track[VX], track[VY]) < FAN_MOVING : id !== only)) continue;
    g.strokeStyle = g.fillStyle = colourOf(id);
    const shown = fan.filter(row => chosen.has(row[FAN_HORIZON]));
    if (!shown.length) continue;
    g.globalAlpha = .7;
    g.setLineDash([2 * thin, 3 * thin]);
    g.beginPath();
    g.moveTo(track[X] / 100, track[Y] / 100);
    for (const row of fan) if (row[FAN_HORIZON] <= shown[shown.length - 1][FAN_HORIZON]) g.lineTo(row[FAN_X] / 100, row[FAN_Y] / 100);
    g.stroke();
    g.setLineDash([]);
    for (const row of shown) {
      const x = row[FAN_X] / 100, y = row[FAN_Y] / 100;
      g.beginPath(); g.arc(x, y, 2 * thin, 0, 7); g.fill();
      if (row[FAN_XX] === null) continue;
      const [a, b, angle] = ellipse(row[FAN_XX] / 1e4, row[FAN_XY] / 1e4, row[FAN_YY] / 1e4);
      g.beginPath(); g.ellipse(x, y, a, b, angle, 0, 7);
      g.globalAlpha = .08; g.fill();
      g.globalAlpha = .5; g.stroke();
    }
  }
  g.restore();
}

function fanHorizons(host, horizons, chosen, changed) {  // a switch for each horizon, ms; `chosen` holds those that are on
  host.replaceChildren(...horizons.map(horizon => {
    const label = document.createElement("label"), input = document.createElement("input");
    input.type = "checkbox"; input.checked = chosen.has(horizon); input.id = `horizon-${horizon}`;
    input.onchange = () => { input.checked ? chosen.add(horizon) : chosen.delete(horizon); changed(); };
    label.append(input, ` ${horizon / 1000} s`);
    return label;
  }));
}
