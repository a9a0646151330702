"use strict";
// Draws the maps of an analysis, and says what is at a point.
(() => {
  const holder = document.getElementById("maps");
  if (!holder) return;
  const blocks = JSON.parse(holder.textContent);
  const tip = document.getElementById("tip");
  const panels = [...document.querySelectorAll("canvas.map")].map((canvas) => {
    const { block, side, kind, index } = canvas.dataset;
    const own = blocks[block].sides[side];
    const item = kind === "mean" ? own.means[index] : own.tests[index];
    const values = kind === "mean" ? item.values : item[kind];
    const scales = blocks[block].scales[kind];
    return { canvas, block: blocks[block], side: own, kind, item, values, scale: kind === "effect" ? scales[item.contrast] : scales };
  });
  let place = null; // [i, j], where the reader is; the same in all maps of a measure
  let active = null;

  const rgb = (hex) => [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));

  function paint({ values, scale, side }) {
    const [nx, ny] = side.shape;
    const picture = document.createElement("canvas");
    [picture.width, picture.height] = [nx, ny];
    const context = picture.getContext("2d");
    const pixels = context.createImageData(nx, ny);
    const colors = scale.colors.map(rgb);
    values.forEach((value, at) => {
      const [i, j] = [Math.floor(at / ny), at % ny];
      const share = Math.min(1, Math.max(0, (value - scale.low) / (scale.high - scale.low)));
      const color = value === null ? [235, 235, 235] : colors[Math.round(share * (colors.length - 1))];
      pixels.data.set([...color, 255], 4 * ((ny - 1 - j) * nx + i));
    });
    context.putImageData(pixels, 0, 0);
    return picture;
  }

  // The borders between cells whose labels differ.
  function outline(context, side, labels, w, h, outside) {
    const [nx, ny] = side.shape;
    const at = (i, j) => (i < 0 || j < 0 || i >= nx || j >= ny ? outside : labels[i * ny + j]);
    const [dx, dy] = [w / nx, h / ny];
    context.beginPath();
    for (let i = 0; i <= nx; i++) for (let j = 0; j <= ny; j++) {
      const inside = outside !== undefined || (i > 0 && i < nx);
      if (j < ny && inside && at(i - 1, j) !== at(i, j)) { context.moveTo(i * dx, h - j * dy); context.lineTo(i * dx, h - (j + 1) * dy); }
      const within = outside !== undefined || (j > 0 && j < ny);
      if (i < nx && within && at(i, j - 1) !== at(i, j)) { context.moveTo(i * dx, h - j * dy); context.lineTo((i + 1) * dx, h - j * dy); }
    }
  }

  function stroke(context, width, color) {
    context.lineWidth = width;
    context.strokeStyle = color;
    context.stroke();
  }

  function nameFields(context, side, w, h) {
    const [nx, ny] = side.shape;
    context.font = "11px sans-serif";
    context.textAlign = "center";
    side.names.forEach((name, number) => {
      let [sum, count] = [0, 0];
      side.subfield.forEach((label, at) => { if (label === number) { sum += Math.floor(at / ny) + 0.5; count += 1; } });
      const half = context.measureText(name).width / 2;
      const x = Math.min(w - half - 4, Math.max(half + 4, ((sum / count) * w) / nx));
      context.fillStyle = "#ffffffc8";
      context.fillRect(x - half - 2, h - 16, 2 * half + 4, 14);
      context.fillStyle = "#1d2329";
      context.fillText(name, x, h - 5);
    });
  }

  function nearest(list, value) {
    return list.reduce((best, other, at) => (Math.abs(other - value) < Math.abs(list[best] - value) ? at : best), 0);
  }

  function numberPeaks(context, { item, side }, w, h) {
    const [nx, ny] = side.shape;
    context.textAlign = "center";
    context.font = "bold 10px sans-serif";
    item.peaks.forEach(([x, y], number) => {
      const [i, j] = [Math.floor(nearest(side.x, x) / ny), nearest(side.y.slice(0, ny), y)];
      const inside = (value, end) => Math.min(end - 8, Math.max(8, value));
      const [px, py] = [inside(((i + 0.5) * w) / nx, w), inside(h - ((j + 0.5) * h) / ny, h)];
      context.beginPath();
      context.arc(px, py, 7, 0, 2 * Math.PI);
      context.fillStyle = "#fff";
      context.fill();
      stroke(context, 1, "#1d2329");
      context.fillStyle = "#1d2329";
      context.fillText(number + 1, px, py + 3.5);
    });
  }

  function draw(panel) {
    const { canvas, side, kind, item } = panel;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    const ratio = Math.max(2, window.devicePixelRatio || 1);
    [canvas.width, canvas.height] = [w * ratio, h * ratio];
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    context.imageSmoothingEnabled = false;
    panel.picture ||= paint(panel);
    context.drawImage(panel.picture, 0, 0, w, h);
    outline(context, side, side.subfield, w, h);
    stroke(context, 2.2, "#ffffffb0");
    stroke(context, 0.8, "#3a424b");
    if (kind !== "mean") {
      outline(context, side, item.significant, w, h, 0);
      stroke(context, 3.6, "#ffffffc0");
      stroke(context, 1.8, "#000");
    }
    nameFields(context, side, w, h);
    if (kind === "effect") numberPeaks(context, panel, w, h);
    if (place && active && panel.block === active.block) {
      const [nx, ny] = side.shape;
      context.beginPath();
      context.rect((place[0] * w) / nx, h - ((place[1] + 1) * h) / ny, w / nx, h / ny);
      stroke(context, 3.5, "#fff");
      stroke(context, 1.5, "#c8006a");
    }
  }

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
      rows.push([is_t ? (df[at] === null ? "z" : `t(${spell(df[at])})`) : "F", spell(statistic[at])], ["p", probability(p[at])]);
      rows.push(["corrected p", probability(adjusted[at]) + (item.significant[at] ? ", survives" : "")]);
      rows.push([is_t ? "Cohen's d" : "partial η²", spell(item.effect[at])], ["n", spell(n[at])]);
    }
    return rows;
  }

  function tell() {
    const { canvas, side } = active;
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
    const box = canvas.getBoundingClientRect();
    const [nx, ny] = side.shape;
    const [px, py] = [box.left + ((place[0] + 0.5) / nx) * box.width, box.top + (1 - (place[1] + 0.5) / ny) * box.height];
    const room = document.documentElement.clientWidth - tip.offsetWidth - 8;
    const left = px + 16 > room ? px - 16 - tip.offsetWidth : px + 16;
    const under = py + 16 + tip.offsetHeight > window.innerHeight;
    tip.style.left = `${window.scrollX + Math.min(Math.max(8, left), Math.max(8, room))}px`;
    tip.style.top = `${window.scrollY + Math.max(4, under ? py - 16 - tip.offsetHeight : py + 16)}px`;
  }

  function show(panel, next) {
    if (active === panel && place && next && place[0] === next[0] && place[1] === next[1]) return;
    const before = active && active.block;
    [active, place] = next ? [panel, next] : [null, null];
    for (const other of panels) if (other.block === before || other.block === panel.block) draw(other);
    if (next) tell();
    else tip.hidden = true;
  }

  const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowDown: [0, -1], ArrowUp: [0, 1] };
  for (const panel of panels) {
    const { canvas, side } = panel;
    const [nx, ny] = side.shape;
    const clip = (value, n) => Math.min(n - 1, Math.max(0, value));
    const under = (event) => {
      const box = canvas.getBoundingClientRect();
      return [clip(Math.floor(((event.clientX - box.left) / box.width) * nx), nx), clip(Math.floor((1 - (event.clientY - box.top) / box.height) * ny), ny)];
    };
    canvas.addEventListener("pointermove", (event) => show(panel, under(event)));
    canvas.addEventListener("pointerdown", (event) => show(panel, under(event)));
    canvas.addEventListener("pointerleave", (event) => { if (event.pointerType === "mouse") show(panel, null); });
    canvas.addEventListener("blur", () => show(panel, null));
    canvas.addEventListener("keydown", (event) => {
      if (event.key === "Escape") return show(panel, null);
      const step = steps[event.key];
      if (!step) return undefined;
      event.preventDefault();
      const from = active === panel ? place : null;
      return show(panel, from ? [clip(from[0] + step[0], nx), clip(from[1] + step[1], ny)] : [Math.floor(nx / 2), Math.floor(ny / 2)]);
    });
  }

  const all = () => panels.forEach(draw);
  let width = 0;
  window.addEventListener("resize", () => {
    if (width !== window.innerWidth) { width = window.innerWidth; all(); }
  });
  all();
})();
