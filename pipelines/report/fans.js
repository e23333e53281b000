// The layer of predictions, and the switches of its horizons.
const FAN_MOVING = 50;  // cm/s, from which a track has a fan while none is followed
const FAN_HORIZON = 1, FAN_X = 2, FAN_Y = 3, FAN_XX = 4, FAN_XY = 5, FAN_YY = 6;
const horizonsOff = new Set();  // ms

function drawFans(view) {  // of the followed track, else of all that move: a line of means, an ellipse at each horizon
  const {g, k, result, tracks, focus, thin} = view, fans = new Map();
  for (const row of focus ? [focus] : tracks) if (row === focus || Math.hypot(row[VX], row[VY]) >= FAN_MOVING) fans.set(row[ID], [row]);
  for (const row of result.predictions[k] ?? []) if (!horizonsOff.has(row[FAN_HORIZON])) fans.get(row[ID])?.push(row);
  g.lineWidth = 1.2 * thin;
  for (const [track, ...fan] of fans.values()) {
    g.strokeStyle = g.fillStyle = view.colour(track);
    g.globalAlpha = .7;
    g.setLineDash([2 * thin, 3 * thin]);
    g.beginPath(); g.moveTo(...middle(track));
    for (const row of fan) g.lineTo(row[FAN_X] / 100, row[FAN_Y] / 100);
    g.stroke();
    g.setLineDash([]);
    for (const row of fan) {
      const place = [row[FAN_X] / 100, row[FAN_Y] / 100];
      g.globalAlpha = .7; g.beginPath(); g.arc(...place, 2 * thin, 0, 7); g.fill();
      if (row[FAN_XX] === null) continue;
      g.beginPath(); g.ellipse(...place, ...ellipse(row[FAN_XX] / 1e4, row[FAN_XY] / 1e4, row[FAN_YY] / 1e4), 0, 7);
      g.globalAlpha = .08; g.fill();
      g.globalAlpha = .5; g.stroke();
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
