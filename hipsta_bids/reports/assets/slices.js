"use strict";
// Draws slices of labels, body, anatomical image, surfaces and columns: those of the page, and any one enlarged.
(() => {
  // Axes of a picture (to the right, up), by the axis across it; 0 is right, 1 anterior, 2 superior.
  const AXES = [[1, 2], [0, 2], [0, 1]], LETTERS = ["LR", "PA", "IS"];
  const DIRECTIONS = ["sagittal", "coronal", "axial"], CORONAL = 1;
  const SURFACES = ["interior", "midthickness", "exterior"];
  const SWIPE = 14, WHEEL = 40; // px of a finger or wheel per slice
  const REACH = 7, GAP = 1.5; // mm, of the line of an end plane from its middle, and of a cross from its point
  const PIN = 24; // px between numbers of findings

  const make = (name, properties = {}, ...children) => {
    const element = Object.assign(document.createElement(name), properties);
    element.append(...children);
    return element;
  };
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));

  async function unpack(text) {
    const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Uint8Array(await new Response(stream).arrayBuffer());
  }

  // Lengths are mm from the corner of the stack, along its axes.
  const place = ({ inverse, edge }, point) => inverse.map((row, k) => edge[k] * (0.5 + row[3] + point.reduce((sum, v, n) => sum + row[n] * (v ?? NaN), 0)));

  async function load(script) {
    const stack = JSON.parse(script.textContent), [part, side] = script.dataset.key.split("-");
    stack.title = script.dataset.title;
    stack.voxels = await unpack(stack.stack);
    stack.edge = [0, 1, 2].map((k) => Math.hypot(...stack.affine.map((row) => row[k])));
    stack.colors = stack.colors.map(rgb);
    if (stack.anatomy) stack.anatomy.voxels = await unpack(stack.anatomy.stack);
    const view = document.querySelector(`.viewer[data-key="${part}-view"] script`);
    const { scenes, scales } = view ? JSON.parse(view.textContent) : { scenes: [] };
    const scene = scenes.find((other) => other.side === side) ?? { findings: [] };
    stack.findings = scene.findings.map((finding) => ({ ...finding, at: place(stack, finding.point) }));
    if (!scene.surfaces) return stack;
    stack.sheet = scene.shape;
    stack.surfaces = SURFACES.map((name) => {
      const flat = scene.surfaces[name];
      return Array.from({ length: flat.length / 3 }, (_, n) => place(stack, flat.slice(3 * n, 3 * n + 3)));
    });
    const { low, high, colors } = scales.thickness;
    stack.ramp = scene.maps.thickness.map((v) => colors[Math.round(Math.min(1, Math.max(0, (v - low) / (high - low))) * (colors.length - 1))]);
    stack.planes = scene.planes.map(({ point, normal }) => {
      const start = place(stack, point);
      return { start, normal: place(stack, point.map((v, k) => v + normal[k])).map((v, k) => v - start[k]) };
    });
    return stack;
  }

  const stacks = {};
  for (const script of document.querySelectorAll("script.stack")) {
    let ready = null;
    stacks[script.dataset.key] = () => (ready ??= load(script));
  }

  // Where a plane cuts a grid of points with so many columns: both ends of each line, and its column.
  function cut(grid, columns, axis, level) {
    const lines = [];
    for (let n = 0; n + columns + 1 < grid.length; n++) {
      if ((n + 1) % columns === 0) continue;
      for (const corners of [[n, n + columns, n + columns + 1], [n, n + columns + 1, n + 1]]) {
        const ends = [], points = corners.map((c) => grid[c]);
        if (points.some((p) => Number.isNaN(p[0]))) continue;
        points.forEach((a, k) => {
          const b = points[(k + 1) % 3], [p, q] = [a[axis] - level, b[axis] - level];
          if (p > 0 !== q > 0) ends.push(a.map((v, m) => v + (p / (p - q)) * (b[m] - v)));
        });
        if (ends.length) lines.push({ ends, column: n % columns });
      }
    }
    return lines;
  }

  // Boxes of all sides are one choice.
  const shown = {}, boxes = [...document.querySelectorAll(".toggles input")];
  for (const { value, checked } of boxes) shown[value] ||= checked;
  for (const box of boxes) box.checked = shown[box.value];

  // A picture of one slice; its box is the corners of what it shows, mm to the right and up.
  class Picture {
    constructor(canvas, stack, across, box) {
      Object.assign(this, { canvas, stack, across, box, point: null });
      [this.right, this.up] = AXES[across];
    }

    go(level) {
      this.level = Math.max(0, Math.min(this.stack.shape[this.across] - 1, Math.round(level)));
      this.draw();
    }

    flat(point) { return [(point[this.right] - this.box[0][0]) * this.scale, (this.box[1][1] - point[this.up]) * this.scale]; }

    draw() {
      const { canvas, stack, across, box } = this, width = canvas.clientWidth, height = canvas.clientHeight;
      if (!width) return;
      const dpr = Math.max(2, window.devicePixelRatio || 1), style = getComputedStyle(document.documentElement);
      this.color = (name) => style.getPropertyValue(`--${name}`);
      this.scale = width / (box[1][0] - box[0][0]);
      Object.assign(canvas, { width: width * dpr, height: height * dpr });
      this.context = canvas.getContext("2d");
      this.context.setTransform(dpr, 0, 0, dpr, 0, 0);
      this.context.fillStyle = this.color("paper");
      this.context.fillRect(0, 0, width, height);
      if (stack.anatomy && shown.anatomy) this.drawAnatomy(stack.anatomy);
      const voxels = this.plane(stack.shape, (n, step) => stack.voxels[n + this.level * step]);
      const clear = [0, 0, 0, 0], colors = stack.colors.map((color) => [...color, Math.round(255 * stack.pale)]);
      if (shown.labels) this.paint(voxels, (v) => colors[(v & 127) - 1] || clear, false);
      if (stack.body && shown.body) this.drawBody(voxels);
      const level = (this.level + 0.5) * stack.edge[across];
      if (stack.surfaces && shown.columns) this.drawColumns(level);
      if (stack.surfaces && shown.surfaces) {
        stack.surfaces.forEach((grid, n) => this.stroke(cut(grid, stack.sheet[1], across, level).map(({ ends }) => ends), this.color(SURFACES[n])));
      }
      if (stack.surfaces && shown.planes) this.stroke(this.planeLines(level), this.color("plane"), [7, 4]);
      if (this.point && Math.abs(this.point[across] - level) < stack.edge[across]) this.drawCross();
      this.annotate(width, height);
    }

    drawAnatomy({ shape, voxels }) {
      const most = shape[this.across] - 1, gray = 255 / (this.stack.levels - 1);
      const level = Math.max(0, Math.min(most, ((this.level + 0.5) / this.stack.shape[this.across]) * (most + 1) - 0.5));
      const low = Math.floor(level), high = Math.min(most, low + 1), share = level - low;
      const grays = this.plane(shape, (n, step) => (1 - share) * voxels[n + low * step] + share * voxels[n + high * step]);
      this.paint(grays, (v) => [v * gray, v * gray, v * gray, 255], true);
    }

    // Values of the slice, (column, row from above), in the order of a picture's pixels.
    plane(shape, at) {
      const { right, up, across } = this, steps = [shape[1] * shape[2], shape[2], 1];
      const [columns, rows] = [shape[right], shape[up]], out = new Float32Array(columns * rows);
      for (let y = 0; y < rows; y++) {
        for (let x = 0; x < columns; x++) out[y * columns + x] = at(x * steps[right] + (rows - 1 - y) * steps[up], steps[across]);
      }
      return { columns, rows, out };
    }

    paint({ columns, rows, out }, color, smooth) {
      const picture = new OffscreenCanvas(columns, rows), context = picture.getContext("2d");
      const pixels = context.createImageData(columns, rows);
      out.forEach((value, n) => pixels.data.set(color(value), 4 * n));
      context.putImageData(pixels, 0, 0);
      const [wide, tall] = [this.right, this.up].map((axis) => this.stack.shape[axis] * this.stack.edge[axis]);
      Object.assign(this.context, { imageSmoothingEnabled: smooth, imageSmoothingQuality: "high" });
      this.context.drawImage(picture, -this.box[0][0] * this.scale, (this.box[1][1] - tall) * this.scale, wide * this.scale, tall * this.scale);
    }

    // Lines with both ends in mm, on a halo of the paper's color unless they are columns.
    stroke(lines, color, dash = [], width = 1.5, halo = 2.5) {
      const { context } = this;
      context.beginPath();
      for (const [a, b] of lines) { context.moveTo(...this.flat(a)); context.lineTo(...this.flat(b)); }
      context.setLineDash(dash);
      context.lineCap = "round";
      for (const [lineWidth, strokeStyle, globalAlpha] of [[width + halo, this.color("paper"), 0.6], [width, color, 1]]) {
        Object.assign(context, { lineWidth, strokeStyle, globalAlpha });
        if (halo || globalAlpha === 1) context.stroke();
      }
      context.setLineDash([]);
    }

    drawBody({ columns, rows, out }) {
      const inside = (x, y) => x >= 0 && y >= 0 && x < columns && y < rows && out[y * columns + x] > 127;
      const corner = (x, y) => { const p = []; p[this.right] = x * this.stack.edge[this.right]; p[this.up] = (rows - y) * this.stack.edge[this.up]; return p; };
      const lines = [];
      for (let y = 0; y <= rows; y++) {
        for (let x = 0; x <= columns; x++) {
          if (inside(x, y) !== inside(x - 1, y)) lines.push([corner(x, y), corner(x, y + 1)]);
          if (inside(x, y) !== inside(x, y - 1)) lines.push([corner(x, y), corner(x + 1, y)]);
        }
      }
      this.stroke(lines, this.color("mask"), [], 1.2);
    }

    // Columns with the same x in slices across the body, with the same y in others.
    drawColumns(level) {
      const { surfaces, sheet: [nx, ny], ramp } = this.stack, along = this.across === CORONAL;
      const at = (s, t) => (along ? s * ny + t : t * ny + s), [many, length] = along ? [nx, ny] : [ny, nx];
      for (let s = 0; s < many; s++) {
        const strip = surfaces.flatMap((points) => Array.from({ length }, (_, t) => points[at(s, t)]));
        for (const { ends, column } of cut(strip, length, this.across, level)) this.stroke([ends], ramp[at(s, column)], [], 1.6, 0);
      }
    }

    planeLines(level) {
      const { right, up, across } = this;
      return this.stack.planes.flatMap(({ start, normal }) => {
        const size = Math.hypot(normal[right], normal[up]), off = level - start[across];
        if (size < 0.05) return []; // parallel to the slice
        const middle = [...start], [u, v] = [normal[right] / size, normal[up] / size];
        middle[right] -= (u * normal[across] * off) / size;
        middle[up] -= (v * normal[across] * off) / size;
        return [[1, -1].map((way) => { const p = [...middle]; p[right] -= way * REACH * v; p[up] += way * REACH * u; return p; })];
      });
    }

    drawCross() {
      const lines = [this.right, this.up].flatMap((axis) => [-1, 1].map((way) => [GAP, 100].map((far) => { const p = [...this.point]; p[axis] += way * far; return p; })));
      this.stroke(lines, this.color("failed"), [], 1.2, 2);
    }

    annotate(width, height) {
      const { context } = this, [left, beyond, below, above] = [...LETTERS[this.right], ...LETTERS[this.up]];
      Object.assign(context, { font: "600 13px system-ui, sans-serif", textAlign: "center", textBaseline: "middle", lineWidth: 3 });
      Object.assign(context, { strokeStyle: this.color("paper"), fillStyle: this.color("ink") });
      for (const [letter, x, y] of [[left, 9, height / 2], [beyond, width - 9, height / 2], [below, width / 2, height - 10], [above, width / 2, 10]]) {
        context.strokeText(letter, x, y);
        context.fillText(letter, x, y);
      }
      const end = [], y = this.box[0][1] + 8 / this.scale;
      end[this.right] = this.box[1][0] - 8 / this.scale;
      end[this.up] = y;
      const start = [...end];
      start[this.right] -= 5; // mm
      this.stroke([[start, end]], this.color("ink"), [], 2, 3);
    }
  }

  const pictures = [];
  const redraw = () => pictures.forEach((picture) => picture.draw());

  // Numbers of findings lie in the slice nearest to them.
  function pin(stack, key, frames) {
    const across = stack.panels.map((panel, n) => ({ ...panel, n })).filter((panel) => panel.across === CORONAL);
    const taken = across.map(() => []);
    for (const finding of stack.findings) {
      const gaps = across.map(({ center }) => finding.at[CORONAL] - (center[CORONAL] + 0.5) * stack.edge[CORONAL]);
      const n = gaps.reduce((best, gap, k) => (Math.abs(gap) < Math.abs(gaps[best]) ? k : best), 0), frame = frames[across[n].n];
      const [low, high] = across[n].box, size = [frame.clientWidth, frame.clientHeight];
      const at = [(finding.at[0] - low[0]) / (high[0] - low[0]), (high[1] - finding.at[2]) / (high[1] - low[1])].map((share, k) => Math.min(size[k] - PIN / 2, Math.max(PIN / 2, share * size[k])));
      const near = ([x, y]) => Math.hypot(x - at[0], y - at[1]) < PIN;
      for (let tries = 0; tries < 50 && taken[n].some(near); tries++) {
        at[0] += PIN / 2;
        if (at[0] > size[0] - PIN / 2) [at[0], at[1]] = [PIN / 2, Math.max(PIN / 2, at[1] - PIN)];
      }
      taken[n].push(at);
      const away = `${Math.abs(gaps[n]).toFixed(1)} mm ${gaps[n] > 0 ? "anterior" : "posterior"} of this slice`;
      const button = make("button", { type: "button", className: `pin ${finding.kind}`, textContent: finding.number, title: `${finding.message} (${away})` });
      Object.assign(button.dataset, { stack: key, point: finding.number });
      button.style.cssText = `left:${(100 * at[0]) / size[0]}%;top:${(100 * at[1]) / size[1]}%`;
      button.setAttribute("aria-label", `Finding ${finding.number}, ${away}`);
      frame.append(button);
    }
  }

  async function begin(key) {
    const frames = [...document.querySelectorAll(`.frame[data-stack="${key}"]`)], stack = await stacks[key]();
    frames.forEach((frame, n) => {
      const { across, center, box } = stack.panels[n], picture = new Picture(frame.querySelector("canvas"), stack, across, box);
      picture.level = Math.max(0, Math.min(stack.shape[across] - 1, Math.round(center[across])));
      pictures.push(picture);
      new ResizeObserver(() => picture.draw()).observe(picture.canvas);
    });
    pin(stack, key, frames);
  }

  class Large {
    constructor() {
      this.canvas = make("canvas", { tabIndex: 0 });
      this.canvas.setAttribute("role", "img");
      this.title = make("h2");
      this.caption = make("p", { className: "facts" });
      this.caption.setAttribute("aria-live", "polite");
      this.words = make("p");
      this.range = make("input", { type: "range", min: 0, step: 1 });
      this.range.setAttribute("aria-label", "slice");
      this.direction = make("select", {}, ...DIRECTIONS.map((name, value) => make("option", { value, textContent: name })));
      this.direction.setAttribute("aria-label", "direction");
      const button = (textContent, label, action) => {
        const element = make("button", { type: "button", textContent, title: label });
        element.setAttribute("aria-label", label);
        element.addEventListener("click", action);
        return element;
      };
      this.layers = make("div", { className: "layers" });
      this.dialog = make("dialog", { className: "slices" },
        make("div", { className: "top" }, this.title, button("×", "Close", () => this.dialog.close())), this.words, this.canvas, this.caption,
        make("div", { className: "move" }, this.direction, button("−", "Previous slice", () => this.go(this.level - 1)), this.range,
          button("+", "Next slice", () => this.go(this.level + 1))), this.layers);
      this.dialog.setAttribute("aria-label", "Slices");
      document.body.append(this.dialog);
      this.listen();
    }

    get level() { return this.picture.level; }

    listen() {
      this.range.addEventListener("input", () => this.go(Number(this.range.value)));
      this.direction.addEventListener("change", () => this.turn(Number(this.direction.value)));
      this.dialog.addEventListener("close", () => { pictures.pop(); this.opener.focus(); });
      this.dialog.addEventListener("click", (event) => { if (event.target === this.dialog) this.dialog.close(); });
      this.dialog.addEventListener("keydown", (event) => {
        const step = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1, PageUp: 5, PageDown: -5, Home: -1e4, End: 1e4 }[event.key];
        if (!step || event.target === this.direction) return;
        event.preventDefault();
        event.stopPropagation();
        this.go(this.level + step);
      });
      let turned = 0, from = null;
      this.dialog.addEventListener("wheel", (event) => {
        event.preventDefault();
        turned -= event.deltaY * (event.deltaMode ? WHEEL : 1);
        const steps = Math.trunc(turned / WHEEL);
        turned -= steps * WHEEL;
        this.go(this.level + steps);
      }, { passive: false });
      this.canvas.addEventListener("pointerdown", (event) => { from = event.clientY; this.canvas.setPointerCapture(event.pointerId); });
      this.canvas.addEventListener("pointermove", (event) => {
        if (from === null) return;
        const steps = Math.trunc((from - event.clientY) / SWIPE);
        from -= steps * SWIPE;
        this.go(this.level + steps);
      });
      for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, () => { from = null; });
      window.addEventListener("resize", () => { if (this.dialog.open) this.fit(); });
    }

    // Opens a slice of the page, or the one through a finding.
    async open(opener, stack, panel, finding) {
      const layers = opener.closest(".card").querySelectorAll(".toggles, .legend");
      Object.assign(this, { opener, stack, finding, center: finding ? finding.at.map((v, k) => v / stack.edge[k] - 0.5) : panel.center });
      this.layers.replaceChildren(...[...layers].map((element) => element.cloneNode(true)));
      for (const box of this.layers.querySelectorAll("input")) box.checked = shown[box.value];
      this.words.textContent = finding ? `${finding.number}: ${finding.message}` : "";
      if (!this.dialog.open) { this.dialog.showModal(); pictures.push(null); }
      this.turn(panel.across);
      this.canvas.focus();
    }

    turn(across) {
      const { stack } = this, boxes = stack.panels.filter((panel) => panel.across === across).map((panel) => panel.box);
      if (!boxes.length) boxes.push([[0, 0], AXES[across].map((axis) => stack.shape[axis] * stack.edge[axis])]);
      const box = [Math.min, Math.max].map((most, end) => [0, 1].map((k) => most(...boxes.map((corners) => corners[end][k]))));
      this.picture = new Picture(this.canvas, stack, across, box);
      this.picture.point = this.finding?.at;
      pictures[pictures.length - 1] = this.picture;
      this.direction.value = across;
      this.title.textContent = `${stack.title}, ${DIRECTIONS[across]}`;
      this.range.max = stack.shape[across] - 1;
      this.picture.level = Math.round(this.center[across]);
      this.fit();
    }

    fit() {
      const [[left, low], [beyond, high]] = this.picture.box;
      const room = [window.innerWidth - 48, Math.max(160, window.innerHeight - 270)];
      const scale = Math.min(room[0] / (beyond - left), room[1] / (high - low));
      Object.assign(this.canvas.style, { width: `${Math.round((beyond - left) * scale)}px`, height: `${Math.round((high - low) * scale)}px` });
      this.go(this.level);
    }

    go(level) {
      this.picture.go(level);
      const { across, stack } = this.picture, { affine, shape, anatomy } = stack;
      this.range.value = this.level;
      const middle = shape.map((n, k) => (k === across ? this.level : (n - 1) / 2));
      const mm = affine[across].reduce((sum, v, k) => sum + v * (k < 3 ? middle[k] : 1), 0);
      this.caption.textContent = `Slice ${this.level + 1} of ${shape[across]}, ${"RAS"[across]} ${mm.toFixed(1)} mm`
        + `${anatomy ? ` · ${anatomy.name}` : ""}`;
      this.canvas.setAttribute("aria-label", this.caption.textContent);
    }
  }

  let large = null;
  document.addEventListener("click", async (event) => {
    const button = event.target.closest("button[data-stack]");
    if (!button || !stacks[button.dataset.stack]) return;
    const stack = await stacks[button.dataset.stack](), { panel, point } = button.dataset;
    large ??= new Large();
    large.open(button, stack, stack.panels[panel ?? 0], stack.findings.find(({ number }) => number === Number(point)));
  });
  document.addEventListener("change", ({ target }) => {
    if (!target.closest(".toggles")) return;
    shown[target.value] = target.checked;
    for (const box of document.querySelectorAll(`.toggles [value=${target.value}]`)) box.checked = target.checked;
    document.body.classList.toggle("unpinned", !shown.findings);
    redraw();
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  // Paper is white, also where the screen is dark.
  for (const [name, light] of [["beforeprint", true], ["afterprint", false]]) {
    window.addEventListener(name, () => { document.documentElement.classList.toggle("paper", light); redraw(); });
  }
  Object.keys(stacks).forEach(begin);
})();
