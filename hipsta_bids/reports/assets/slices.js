"use strict";
// Enlarges a slice of the labels, and moves through all slices of that direction.
(() => {
  // Axes of a picture (to the right, up), by the axis across it; 0 is right, 1 anterior, 2 superior.
  const AXES = [[1, 2], [0, 2], [0, 1]];
  const DIRECTIONS = ["sagittal", "coronal", "axial"];
  const LETTERS = ["LR", "PA", "IS"];
  const SWIPE = 14, WHEEL = 40; // px of a finger or wheel per slice

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

  // What a page holds of one hemisphere; unpacked when it is first looked at.
  const stacks = {};
  for (const script of document.querySelectorAll("script.stack")) {
    let ready = null;
    stacks[script.dataset.key] = () => {
      ready ??= (async () => {
        const stack = JSON.parse(script.textContent);
        stack.title = script.dataset.title;
        stack.voxels = await unpack(stack.stack);
        stack.edge = [0, 1, 2].map((k) => Math.hypot(...stack.affine.map((row) => row[k])));
        stack.colors = stack.colors.map(rgb);
        if (stack.anatomy) stack.anatomy.voxels = await unpack(stack.anatomy.stack);
        return stack;
      })();
      return ready;
    };
  }

  // Light copies behind dark lines; made here, so that pages stay small.
  for (const line of document.querySelectorAll(".panels:not(.five) .line")) {
    const halo = line.cloneNode();
    halo.classList.replace("line", "halo");
    line.before(halo);
  }

  class Slices {
    constructor() {
      this.canvas = make("canvas", { tabIndex: 0 });
      this.canvas.setAttribute("role", "img");
      this.title = make("h2");
      this.caption = make("p", { className: "facts" });
      this.caption.setAttribute("aria-live", "polite");
      this.range = make("input", { type: "range", min: 0, step: 1 });
      this.range.setAttribute("aria-label", "slice");
      const button = (textContent, label, action) => {
        const element = make("button", { type: "button", textContent, title: label });
        element.setAttribute("aria-label", label);
        element.addEventListener("click", action);
        return element;
      };
      this.toggles = {};
      const toggles = ["anatomy", "labels", "body"].map((name) => {
        this.toggles[name] = make("input", { type: "checkbox", checked: true, value: name });
        this.toggles[name].addEventListener("change", () => this.draw());
        return make("label", {}, this.toggles[name], ` ${name}`);
      });
      this.close = button("×", "Close", () => this.dialog.close());
      this.legend = make("ul", { className: "legend" });
      this.dialog = make("dialog", { className: "slices" },
        make("div", { className: "top" }, this.title, this.close), this.canvas, this.caption,
        make("div", { className: "move" }, button("−", "Previous slice", () => this.go(this.level - 1)), this.range,
          button("+", "Next slice", () => this.go(this.level + 1)), ...toggles),
        this.legend);
      this.dialog.setAttribute("aria-label", "Slices");
      document.body.append(this.dialog);
      this.listen();
    }

    listen() {
      this.range.addEventListener("input", () => this.go(Number(this.range.value)));
      this.dialog.addEventListener("close", () => this.opener.focus());
      this.dialog.addEventListener("click", (event) => { if (event.target === this.dialog) this.dialog.close(); });
      this.dialog.addEventListener("keydown", (event) => {
        const step = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1, PageUp: 5, PageDown: -5, Home: -1e4, End: 1e4 }[event.key];
        if (!step) return;
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
      window.addEventListener("resize", () => { if (this.dialog.open) this.draw(); });
    }

    async open(button) {
      const { stack: key, across, level, point } = button.dataset;
      if (!stacks[key]) return;
      this.opener = button;
      this.stack = await stacks[key]();
      this.across = Number(across);
      this.point = point ? point.split(" ").map(Number) : null;
      this.title.textContent = `${this.stack.title}, ${DIRECTIONS[this.across]}`;
      this.range.max = this.stack.shape[this.across] - 1;
      this.toggles.anatomy.parentElement.hidden = !this.stack.anatomy;
      this.toggles.body.parentElement.hidden = !this.stack.body;
      const legend = button.closest("section").querySelector(".legend");
      this.legend.replaceChildren(...(legend ? legend.cloneNode(true).children : []));
      if (!this.dialog.open) this.dialog.showModal();
      this.canvas.focus();
      this.go(Number(level));
    }

    go(level) {
      this.level = Math.max(0, Math.min(this.stack.shape[this.across] - 1, level));
      this.range.value = this.level;
      const { affine, shape, anatomy } = this.stack, middle = shape.map((n) => (n - 1) / 2);
      middle[this.across] = this.level;
      const mm = affine[this.across].reduce((sum, v, k) => sum + v * (k < 3 ? middle[k] : 1), 0);
      this.caption.textContent = `Slice ${this.level + 1} of ${shape[this.across]}, ${"RAS"[this.across]} ${mm.toFixed(1)} mm`
        + `${anatomy ? ` · ${anatomy.name}` : ""}`;
      this.canvas.setAttribute("aria-label", this.caption.textContent);
      this.draw();
    }

    // Labels of the slice, (column, row from above), in the order of a picture's pixels.
    plane(shape, at) {
      const [right, up] = AXES[this.across], steps = [shape[1] * shape[2], shape[2], 1];
      const [columns, rows] = [shape[right], shape[up]], out = new Float32Array(columns * rows);
      for (let y = 0; y < rows; y++) {
        for (let x = 0; x < columns; x++) out[y * columns + x] = at(x * steps[right] + (rows - 1 - y) * steps[up], steps[this.across]);
      }
      return { columns, rows, out };
    }

    paint({ columns, rows, out }, color) {
      const picture = new OffscreenCanvas(columns, rows), context = picture.getContext("2d");
      const pixels = context.createImageData(columns, rows);
      out.forEach((value, n) => pixels.data.set(color(value), 4 * n));
      context.putImageData(pixels, 0, 0);
      return picture;
    }

    draw() {
      const { stack, across } = this, [right, up] = AXES[across];
      const [wide, tall] = [stack.shape[right] * stack.edge[right], stack.shape[up] * stack.edge[up]];
      const room = [Math.min(window.innerWidth - 48, 900), Math.max(160, window.innerHeight - 260)];
      const scale = Math.min(room[0] / wide, room[1] / tall), dpr = window.devicePixelRatio || 1;
      const [width, height] = [Math.round(wide * scale), Math.round(tall * scale)];
      Object.assign(this.canvas, { width: width * dpr, height: height * dpr });
      Object.assign(this.canvas.style, { width: `${width}px`, height: `${height}px` });
      const context = this.canvas.getContext("2d");
      context.setTransform(dpr, 0, 0, dpr, 0, 0);
      context.fillStyle = "#fff";
      context.fillRect(0, 0, width, height);
      const { anatomy } = stack;
      if (anatomy && this.toggles.anatomy.checked) {
        const most = anatomy.shape[across] - 1;
        const level = Math.max(0, Math.min(most, ((this.level + 0.5) / stack.shape[across]) * (most + 1) - 0.5));
        const low = Math.floor(level), high = Math.min(most, low + 1), share = level - low;
        const grays = this.plane(anatomy.shape, (n, step) => (1 - share) * anatomy.voxels[n + low * step] + share * anatomy.voxels[n + high * step]);
        const gray = 255 / (stack.levels - 1);
        context.imageSmoothingQuality = "high";
        context.drawImage(this.paint(grays, (v) => [v * gray, v * gray, v * gray, 255]), 0, 0, width, height);
      }
      const voxels = this.plane(stack.shape, (n, step) => stack.voxels[n + this.level * step]);
      if (this.toggles.labels.checked) {
        const clear = [0, 0, 0, 0], colors = stack.colors.map((color) => [...color, Math.round(255 * stack.pale)]);
        context.imageSmoothingEnabled = false;
        context.drawImage(this.paint(voxels, (v) => colors[(v & 127) - 1] || clear), 0, 0, width, height);
      }
      if (stack.body && this.toggles.body.checked) this.outline(context, voxels, width, height);
      this.annotate(context, width, height, scale);
    }

    outline(context, { columns, rows, out }, width, height) {
      const inside = (x, y) => x >= 0 && y >= 0 && x < columns && y < rows && out[y * columns + x] > 127;
      const [w, h] = [width / columns, height / rows];
      context.beginPath();
      for (let y = 0; y <= rows; y++) {
        for (let x = 0; x <= columns; x++) {
          if (inside(x, y) !== inside(x - 1, y)) { context.moveTo(x * w, y * h); context.lineTo(x * w, (y + 1) * h); }
          if (inside(x, y) !== inside(x, y - 1)) { context.moveTo(x * w, y * h); context.lineTo((x + 1) * w, y * h); }
        }
      }
      for (const [size, style] of [[4, "#fffc"], [1.6, "#1d2329"]]) this.stroke(context, size, style);
    }

    stroke(context, size, style) {
      Object.assign(context, { lineWidth: size, strokeStyle: style });
      context.stroke();
    }

    annotate(context, width, height, scale) {
      const [right, up] = AXES[this.across];
      if (this.point && Math.round(this.point[this.across]) === this.level) {
        const x = ((this.point[right] + 0.5) / this.stack.shape[right]) * width;
        const y = (1 - (this.point[up] + 0.5) / this.stack.shape[up]) * height, gap = 1.5 * scale;
        context.beginPath();
        for (const [x0, y0, x1, y1] of [[x, 0, x, y - gap], [x, y + gap, x, height], [0, y, x - gap, y], [x + gap, y, width, y]]) {
          context.moveTo(x0, y0);
          context.lineTo(x1, y1);
        }
        for (const [size, style] of [[3, "#fffc"], [1.2, "#a11218"]]) this.stroke(context, size, style);
      }
      context.font = "600 15px system-ui, sans-serif";
      context.textAlign = "center";
      context.textBaseline = "middle";
      const [left, beyond, below, above] = [...LETTERS[right], ...LETTERS[up]];
      for (const [letter, x, y] of [[left, 10, height / 2], [beyond, width - 10, height / 2], [below, width / 2, height - 11], [above, width / 2, 11]]) {
        Object.assign(context, { lineWidth: 3, strokeStyle: "#fff", fillStyle: "#1d2329" });
        context.strokeText(letter, x, y);
        context.fillText(letter, x, y);
      }
      context.beginPath();
      context.moveTo(width - 8 - 5 * scale, height - 8);
      context.lineTo(width - 8, height - 8);
      for (const [size, style] of [[5, "#fff"], [2, "#1d2329"]]) this.stroke(context, size, style);
    }
  }

  let viewer = null;
  document.addEventListener("click", (event) => {
    const button = event.target.closest("button.enlarge");
    if (!button) return;
    viewer ??= new Slices();
    viewer.open(button);
  });
})();
