// Faults of a result beside the truth, and differences of two results, that are visited one after the other.
//   comparisons of a scene  {reference: name of a method, null: the truth; found: name, events: [[kind, first and last moment, x, y, id, id, id before]]}
const SWITCH = 0, UNMATCHED = 1, ADDED = 2;  // kinds: other identity, box of the reference alone, box of what is found alone
const VISITS = {  // key, what it is called, kinds, whether beside the truth
  switch: ["s", "switch", "switches", [SWITCH], true],
  miss: ["m", "miss", "misses", [UNMATCHED], true],
  false: ["f", "false box", "false boxes", [ADDED], true],
  difference: ["v", "difference", "differences", [SWITCH, UNMATCHED, ADDED], false],
};

function makeVisits(visit, moment) {
  let scene = null, lists = {}, now = null;

  function text({kind, from, to, id, other, before}, {reference, found}) {
    const seconds = to > from ? `for ${(scene.times[to] - scene.times[from]).toFixed(1)} s` : "for a moment", named = name => shortName(name).slice(0, 12);
    if (kind === SWITCH) return `${reference ? `${reference}: ${named(other)}` : `object ${named(other)}`}, ${reference ? `${found}: ` : "track "}${named(before)} → ${named(id)}`;
    if (reference) return kind === ADDED ? `${named(id)} in ${found} alone ${seconds}` : `${named(other)} in ${reference} alone ${seconds}`;
    return kind === ADDED ? `track ${named(id)} without an object ${seconds}` : `object ${named(other)} without a track ${seconds}`;
  }

  function choose(chosen, names) {  // of the method on the right beside the truth; of both, where there are two
    scene = chosen; now = null; lists = {};
    for (const [name, [, , , kinds, judged]] of Object.entries(VISITS)) {
      const fits = each => judged ? each.reference === null && each.found === names[names.length - 1]
        : names.length > 1 && names.includes(each.found) && names.includes(each.reference) && names[0] !== names[1];
      const comparison = scene.comparisons.find(fits);
      if (!comparison) continue;
      lists[name] = comparison.events.filter(event => kinds.includes(event[0])).map(([kind, from, to, x, y, other, id, before]) => {
        const event = {kind, from, to, k: from, place: [x / 100, y / 100], id, other, before};
        const method = id === null ? comparison.reference : comparison.found;
        return {...event, method, id: id ?? other, text: text(event, comparison)};
      });
    }
    $("visits").replaceChildren(...Object.entries(lists).map(([name, list]) => {
      const [key, one, many] = VISITS[name], group = document.createElement("span");
      const buttons = [["‹", -1, `${one} before: shift and ${key}`], ["›", 1, `next ${one}: ${key}`]].map(([sign, step, title]) => {
        const made = document.createElement("button");
        Object.assign(made, {type: "button", textContent: sign, title, disabled: !list.length, onclick: () => go(name, step)});
        made.id = `${step > 0 ? "next" : "last"}-${name}`; made.setAttribute("aria-label", title);
        return made;
      });
      group.append(buttons[0], ` ${list.length} ${list.length === 1 ? one : many} `, buttons[1]);
      return group;
    }), Object.assign(document.createElement("output"), {id: "visited"}));
  }

  function go(name, step) {  // to the next one after this moment, or before it; around the end
    const list = lists[name] ?? [];
    if (!list.length) return;
    const at = list.indexOf(now?.event), k = moment();
    const after = list.findIndex(event => event.k > k), before = list.findLastIndex(event => event.k < k);
    const next = at >= 0 ? at + step : step > 0 ? (after < 0 ? 0 : after) : before;
    const number = (next + list.length) % list.length;
    now = {name, event: list[number]};
    visit(now.event);
    $("visited").value = `${VISITS[name][1]} ${number + 1} of ${list.length}: ${now.event.text}`;
  }

  function leave() { now = null; if ($("visited")) $("visited").value = ""; }

  function draw({g, k, thin}) {  // a ring around it while it lasts
    if (!now || k < now.event.from || k > now.event.to) return;
    g.strokeStyle = "#c2185b"; g.lineWidth = 2.5 * thin; g.globalAlpha = 1;
    g.beginPath(); g.arc(...now.event.place, Math.max(3, 22 * thin), 0, 7); g.stroke();
  }

  function keys(scenes) {
    const there = judged => scenes.some(each => each.comparisons.some(one => judged === (one.reference === null)));
    return Object.fromEntries(Object.entries(VISITS).filter(([, [, , , , judged]]) => there(judged)).flatMap(([name, [key, one]]) => [
      [key, [key, `next ${one}; with shift: the one before`, () => go(name, 1)]], [key.toUpperCase(), ["", "", () => go(name, -1)]]]));
  }

  return {choose, leave, draw, keys, place: () => now?.event.place};
}
