"use strict";
// Lets boxes of long tables end with a whole row.
(() => {
  function fit() {
    for (const box of document.querySelectorAll(".tall")) {
      box.style.removeProperty("--rows");
      const most = parseFloat(getComputedStyle(box).maxHeight);
      if (!(box.scrollHeight > most)) continue;
      const room = most - (box.offsetHeight - box.clientHeight);
      const top = box.getBoundingClientRect().top - box.scrollTop;
      const ends = [...box.querySelectorAll("tbody tr")].map((row) => row.getBoundingClientRect().bottom - top);
      const last = ends.filter((end) => end <= room).pop();
      if (last) box.style.setProperty("--rows", `${last + most - room}px`);
    }
  }
  fit();
  window.addEventListener("resize", fit);
  document.addEventListener("toggle", fit, true);
})();
// Says what is at a point of the maps of an analysis.
(() => {
  const holder = document.getElementById("maps");
  if (!holder) return;
  const blocks = JSON.parse(holder.textContent);
  const tip = document.getElementById("tip");
  const panels = [...document.querySelectorAll(".map")].map((spot) => {
    const { block, side, kind, index } = spot.dataset;
    const own = blocks[block].sides[side];
    return { spot, block: blocks[block], side: own, kind, item: (kind === "mean" ? own.means : own.tests)[index], mark: document.createElement("i") };
  });
  let place = null; // [i, j], where the reader is; the same in all maps of a measure
  let active = null;

  const minus = (text) => text.replace("-", "\u2212");
  function spell(value) {
    if (value === null || value === undefined) return "n/a";
    const size = Math.abs(value);
    return minus(size !== 0 && (size < 0.001 || size >= 1e5) ? value.toExponential(1) : String(Number(value.toPrecision(3))));
  }
  const probability = (p) => (p === null ? "n/a" : p < 0.001 ? `${minus(p.toExponential(1))}` : p.toFixed(3));

  function told({ block, side, kind, item }) {
    const at = place[0] * side.shape[1] + place[1];
    const unit = block.unit ? ` ${block.unit}` : "";
    const rows = [["Place", `x ${spell(side.x[at])}, y ${spell(side.y[at])}`]];
    rows.push(["Subfield", side.names[side.subfield[at]] || "n/a"]);
    for (const group of side.means) rows.push([`Mean, ${group.group}`, spell(group.values[at]) + unit]);
    if (kind !== "mean") {
      const { estimate, statistic, df, p, p_corrected: adjusted, n } = item.values;
      const is_t = item.kind === "t";
      if (is_t) rows.push([item.contrast, spell(estimate[at]) + unit]);
      const name = item.kind === "z" || (is_t && df[at] === null) ? "z" : is_t ? `t(${spell(df[at])})` : "F";
      rows.push([name, spell(statistic[at])]);
      for (const [part, values] of item.parts) rows.push([part, probability(values[at])]);
      rows.push(["p", probability(p[at])]);
      rows.push(["corrected p", probability(adjusted[at]) + (item.significant[at] ? ", survives" : "")]);
      if (item.kind !== "z") rows.push([is_t ? "Cohen's d" : "partial η²", spell(item.effect[at])]);
      rows.push(["n", spell(n[at])]);
    }
    return rows;
  }

  function tell() {
    const { spot, side } = active;
    const head = document.createElement("b");
    head.textContent = `${side.title[0].toUpperCase()}${side.title.slice(1)}, node ${place[0] + 1}, ${place[1] + 1}`;
    const list = document.createElement("dl");
    for (const [name, text] of told(active)) {
      const [term, value] = [document.createElement("dt"), document.createElement("dd")];
      [term.textContent, value.textContent] = [name, text];
      list.append(term, value);
    }
    tip.replaceChildren(head, list);
    tip.hidden = false;
    const box = spot.getBoundingClientRect();
    const [nx, ny] = side.shape;
    const [px, py] = [box.left + ((place[0] + 0.5) / nx) * box.width, box.top + (1 - (place[1] + 0.5) / ny) * box.height];
    const room = document.documentElement.clientWidth - tip.offsetWidth - 8;
    const left = px + 16 > room ? px - 16 - tip.offsetWidth : px + 16;
    const under = py + 16 + tip.offsetHeight > window.innerHeight;
    tip.style.left = `${window.scrollX + Math.min(Math.max(8, left), Math.max(8, room))}px`;
    tip.style.top = `${window.scrollY + Math.max(4, under ? py - 16 - tip.offsetHeight : py + 16)}px`;
  }

  function mark({ spot, side, block, mark }) {
    if (!place || block !== active.block) return mark.remove();
    const [nx, ny] = side.shape;
    const box = { left: place[0] / nx, top: 1 - (place[1] + 1) / ny, width: 1 / nx, height: 1 / ny };
    for (const [name, share] of Object.entries(box)) mark.style[name] = `${100 * share}%`;
    return spot.append(mark);
  }

  function show(panel, next) {
    if (active === panel && place && next && place[0] === next[0] && place[1] === next[1]) return;
    [active, place] = next ? [panel, next] : [null, null];
    panels.forEach(mark);
    if (next) tell();
    else tip.hidden = true;
  }

  const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] };
  for (const panel of panels) {
    const { spot, side } = panel;
    const [nx, ny] = side.shape;
    const clip = (value, n) => Math.min(n - 1, Math.max(0, value));
    const under = (event) => {
      const box = spot.getBoundingClientRect();
      return [clip(Math.floor(((event.clientX - box.left) / box.width) * nx), nx), clip(Math.floor((1 - (event.clientY - box.top) / box.height) * ny), ny)];
    };
    spot.addEventListener("pointermove", (event) => show(panel, under(event)));
    spot.addEventListener("pointerdown", (event) => show(panel, under(event)));
    spot.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") show(panel, null); });
    spot.addEventListener("blur", () => show(panel, null));
    spot.addEventListener("keydown", (event) => {
      if (event.key === "Escape") return show(panel, null);
      const step = steps[event.key];
      if (!step) return undefined;
      event.preventDefault();
      const from = active === panel ? place : null;
      return show(panel, from ? [clip(from[0] + step[0], nx), clip(from[1] + step[1], ny)] : [Math.floor(nx / 2), Math.floor(ny / 2)]);
    });
  }
})();
