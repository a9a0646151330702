"use strict";
// The sheet in three dimensions beside its unfolded map. Scanner RAS is drawn with superior up.
(() => {
  const GRAY = [0.72, 0.74, 0.77];
  const KINDS = { failure: [0.63, 0.07, 0.09], flag: [0.85, 0.45, 0.0], repair: [0.04, 0.33, 0.58] };
  const VERTEX = `
    attribute vec3 position, normal, color;
    uniform mat4 modelViewMatrix, projectionMatrix; uniform mat3 normalMatrix;
    varying vec3 vNormal, vColor, vView;
    void main() {
      vec4 at = modelViewMatrix * vec4(position, 1.0);
      vNormal = normalMatrix * normal; vColor = color; vView = -at.xyz;
      gl_Position = projectionMatrix * at;
    }`;
  // Where the sheet faces the eye its color is that of the legend; elsewhere it is darker, of the same hue.
  const FRAGMENT = `
    precision highp float;
    uniform float opacity, flatness;
    varying vec3 vNormal, vColor, vView;
    void main() {
      vec3 n = normalize(vNormal), v = normalize(vView);
      if (dot(n, v) < 0.0) n = -n;
      float light = 0.6 + 0.4 * clamp(dot(n, normalize(v + vec3(0.2, 0.35, 0.1))), 0.0, 1.0);
      float edge = opacity < 1.0 ? mix(opacity, min(1.0, opacity * 2.6), pow(1.0 - abs(dot(n, v)), 2.0)) : 1.0;
      gl_FragColor = vec4(vColor * mix(light, 1.0, flatness), edge);
    }`;
  const EDGES = ["medial edge", "lateral edge"], ENDS = ["posterior end plane", "anterior end plane"];

  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
  const toScene = ([r, a, s]) => [r, s, -a];

  function triangles(nx, ny) {
    const out = [];
    for (let i = 0; i < nx - 1; i++) {
      for (let j = 0; j < ny - 1; j++) {
        const a = i * ny + j, b = a + ny;
        out.push(a, b, b + 1, a, b + 1, a + 1);
      }
    }
    return out;
  }

  function normals(points, index) {
    const out = new Float32Array(points.length);
    for (let t = 0; t < index.length; t += 3) {
      const [a, b, c] = [index[t] * 3, index[t + 1] * 3, index[t + 2] * 3];
      const u = [0, 1, 2].map((k) => points[b + k] - points[a + k]);
      const v = [0, 1, 2].map((k) => points[c + k] - points[a + k]);
      const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      for (const corner of [a, b, c]) for (let k = 0; k < 3; k++) out[corner + k] += n[k];
    }
    return out;
  }

  // A tube round a line of points, as WebGL's own lines are one pixel wide.
  function tube(line, radius, sides = 8) {
    const points = [], index = [];
    line.forEach((p, i) => {
      const q = line[Math.min(i + 1, line.length - 1)], o = line[Math.max(i - 1, 0)];
      const t = new OGL.Vec3(q[0] - o[0], q[1] - o[1], q[2] - o[2]).normalize();
      const u = new OGL.Vec3(Math.abs(t.x) < 0.8 ? 1 : 0, Math.abs(t.x) < 0.8 ? 0 : 1, 0).cross(t).normalize();
      const v = new OGL.Vec3().cross(t, u);
      for (let k = 0; k < sides; k++) {
        const c = Math.cos((2 * Math.PI * k) / sides) * radius, s = Math.sin((2 * Math.PI * k) / sides) * radius;
        points.push(p[0] + c * u.x + s * v.x, p[1] + c * u.y + s * v.y, p[2] + c * u.z + s * v.z);
        if (i) {
          const a = (i - 1) * sides + k, b = (i - 1) * sides + ((k + 1) % sides);
          index.push(a, b, b + sides, a, b + sides, a + sides);
        }
      }
    });
    return { points, index };
  }

  function ball(center, radius) {
    const points = [], index = [], n = 10;
    for (let i = 0; i <= n; i++) {
      for (let j = 0; j <= 2 * n; j++) {
        const p = (Math.PI * i) / n, q = (Math.PI * j) / n;
        points.push(center[0] + radius * Math.sin(p) * Math.cos(q), center[1] + radius * Math.cos(p), center[2] + radius * Math.sin(p) * Math.sin(q));
      }
    }
    for (let i = 0; i < n; i++) {
      for (let j = 0; j < 2 * n; j++) {
        const a = i * (2 * n + 1) + j, b = a + 2 * n + 1;
        index.push(a, b, b + 1, a, b + 1, a + 1);
      }
    }
    return { points, index };
  }

  class Viewer {
    constructor(root) {
      this.root = root;
      const { scenes, scales } = JSON.parse(root.querySelector("script").textContent);
      this.scenes = scenes;
      this.scales = scales;
      this.solid = root.querySelector(".solid");
      this.flat = root.querySelector(".flat");
      this.number = 0;
      this.node = null;
      this.start();
      this.listen();
      this.choose(0);
      new ResizeObserver(() => this.resize()).observe(root.querySelector(".scene"));
    }

    get scene() { return this.scenes[this.number]; }
    get coloring() { return this.root.querySelector("select").value; }
    shows(name) { return this.root.querySelector(`.show [value=${name}]`).checked; }

    start() {
      try {
        this.renderer = new OGL.Renderer({ canvas: this.solid, dpr: Math.min(window.devicePixelRatio, 2), antialias: true });
      } catch { /* no WebGL */ }
      if (!this.renderer || !this.renderer.gl) {
        this.renderer = null;
        this.root.querySelector(".fallback").hidden = false;
        for (const name of [".scene", ".show", ".reset"]) this.root.querySelector(name).hidden = true;
        return;
      }
      this.gl = this.renderer.gl;
      this.pins = this.root.querySelector(".pins");
      this.camera = new OGL.Camera(this.gl, { fov: 28, near: 1, far: 500 });
      // The wheel scrolls the page until the view has been clicked.
      this.solid.addEventListener("wheel", (event) => {
        if (document.activeElement !== this.solid) event.stopImmediatePropagation();
      }, { capture: true });
      this.camera.position.set(0, 30, 60);
      this.orbit = new OGL.Orbit(this.camera, { element: this.solid, inertia: 0, ease: 1, rotateSpeed: 0.5, minDistance: 10, maxDistance: 200 });
      this.raycast = new OGL.Raycast();
    }

    listen() {
      this.root.addEventListener("change", (event) => {
        if (event.target.type === "radio") this.choose(Number(event.target.value));
        else this.redraw();
      });
      this.root.querySelector(".reset").addEventListener("click", () => this.look());
      this.flat.addEventListener("click", (event) => {
        const box = this.flat.getBoundingClientRect(), [nx, ny] = this.scene.shape;
        const x = (event.clientX - box.left) / box.width;
        const y = 1 - (event.clientY - box.top) / box.height;
        this.pick(Math.min(nx - 1, Math.floor(x * nx)), Math.min(ny - 1, Math.floor(y * ny)));
      });
      this.flat.addEventListener("keydown", (event) => {
        const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
        if (!step || !this.scene.shape) return;
        event.preventDefault();
        const [nx, ny] = this.scene.shape;
        const [i, j] = this.node || [Math.floor(nx / 2), Math.floor(ny / 2)];
        this.pick(Math.max(0, Math.min(nx - 1, i + step[0])), Math.max(0, Math.min(ny - 1, j + step[1])));
      });
      if (!this.renderer) return;
      // Paper is white, whatever the screen is; see slices.js.
      window.addEventListener("beforeprint", () => { this.redraw(); this.still(); });
      window.addEventListener("afterprint", () => this.redraw());
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
      let down = null;
      this.solid.addEventListener("pointerdown", (event) => { down = [event.clientX, event.clientY]; this.solid.focus({ preventScroll: true }); });
      this.solid.addEventListener("pointerup", (event) => {
        if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 4) this.pickAt(event);
        down = null;
      });
      this.solid.addEventListener("keydown", (event) => {
        const turn = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, -0.12], ArrowDown: [0, 0.12] }[event.key];
        const zoom = { "+": 0.88, "=": 0.88, "-": 1.14 }[event.key];
        if (!turn && !zoom) return;
        event.preventDefault();
        const p = this.camera.position.sub(this.orbit.target), length = p.len();
        let theta = Math.atan2(p.x, p.z), phi = Math.acos(p.y / length);
        if (turn) { theta += turn[0]; phi = Math.max(0.05, Math.min(3.09, phi + turn[1])); }
        const r = length * (zoom || 1);
        this.camera.position.set(r * Math.sin(phi) * Math.sin(theta), r * Math.cos(phi), r * Math.sin(phi) * Math.cos(theta)).add(this.orbit.target);
        this.orbit.forcePosition();
      });
      const loop = () => { requestAnimationFrame(loop); this.frame(); };
      requestAnimationFrame(loop);
    }

    choose(number) {
      this.number = number;
      this.node = null;
      const scene = this.scene;
      if (scene.surfaces) {
        this.points = {};
        for (const [name, flat] of Object.entries(scene.surfaces)) {
          const out = new Float32Array(flat.length);
          for (let n = 0; n < flat.length; n += 3) out.set(toScene(flat.slice(n, n + 3)), n);
          this.points[name] = out;
        }
        this.index = triangles(...scene.shape);
      }
      const base = scene.surfaces ? this.points.midthickness : Float32Array.from(scene.body.vertices);
      if (!scene.surfaces) {
        for (let n = 0; n < base.length; n += 3) base.set(toScene(scene.body.vertices.slice(n, n + 3)), n);
        this.body = base;
      }
      const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
      base.forEach((v, n) => { if (!Number.isNaN(v)) { low[n % 3] = Math.min(low[n % 3], v); high[n % 3] = Math.max(high[n % 3], v); } });
      this.center = low.map((v, k) => (v + high[k]) / 2);
      this.half = low.map((v, k) => (high[k] - v) / 2);
      this.radius = Math.hypot(...this.half);
      this.root.querySelector(".side").hidden = !scene.surfaces;
      this.root.querySelector(".colors").hidden = !scene.surfaces;
      this.look();
      this.redraw();
    }

    look() {
      if (!this.renderer) return;
      // From above, behind and lateral, so that the sheet's length and bend both show.
      const side = this.scene.hemi === "L" ? -1 : 1, { clientWidth, clientHeight } = this.root.querySelector(".scene");
      const far = Math.max(3.4, (4.2 * clientHeight) / clientWidth) * this.radius; // clear of a narrow frame, too
      const d = new OGL.Vec3(side * 0.55, 0.75, 0.7).normalize().multiply(far);
      this.orbit.target.set(...this.center);
      this.camera.position.set(this.center[0] + d.x, this.center[1] + d.y, this.center[2] + d.z);
      this.orbit.forcePosition();
    }

    colors() {
      const scene = this.scene, [nx, ny] = scene.shape, kind = this.coloring, out = [];
      const scale = this.scales[kind], ramp = this.scales.thickness.colors.map(rgb);
      const table = scale ? scale.colors.map(rgb) : ramp;
      for (let n = 0; n < nx * ny; n++) {
        let share = null;
        if (scale) {
          const value = scene.maps[kind][n];
          share = value === null ? null : (value - scale.low) / (scale.high - scale.low);
        } else if (kind === "x") share = Math.floor(n / ny) / (nx - 1);
        else if (kind === "y") share = (n % ny) / (ny - 1);
        else {
          const at = scene.subfield[n];
          out.push(at < 0 ? GRAY : rgb(scene.subfields[at].color));
          continue;
        }
        out.push(share === null ? GRAY : table[Math.round(Math.max(0, Math.min(1, share)) * (table.length - 1))]);
      }
      return out;
    }

    mesh(points, index, color, { opacity = 1, flatness = 0, depthTest = true, order = 0 } = {}) {
      const count = points.length / 3, colors = new Float32Array(points.length);
      for (let n = 0; n < count; n++) colors.set(Array.isArray(color[0]) ? color[n] : color, 3 * n);
      const position = Float32Array.from(points);
      const geometry = new OGL.Geometry(this.gl, {
        position: { size: 3, data: position }, normal: { size: 3, data: normals(position, index) },
        color: { size: 3, data: colors }, index: { data: new Uint32Array(index) },
      });
      const program = new OGL.Program(this.gl, {
        vertex: VERTEX, fragment: FRAGMENT, cullFace: false, transparent: opacity < 1 || order > 0, depthWrite: opacity === 1, depthTest,
        uniforms: { opacity: { value: opacity }, flatness: { value: flatness } },
      });
      const mesh = new OGL.Mesh(this.gl, { geometry, program, renderOrder: order });
      mesh.setParent(this.world);
      return mesh;
    }

    row(name, i) {
      const ny = this.scene.shape[1], from = this.points[name];
      return Array.from({ length: ny }, (_, j) => Array.from(from.slice(3 * (i * ny + j), 3 * (i * ny + j) + 3)));
    }

    redraw() {
      if (this.scene.surfaces) this.drawFlat();
      if (!this.renderer) return;
      const scene = this.scene, style = getComputedStyle(document.documentElement);
      const [wash, ink] = ["wash", "ink"].map((name) => rgb(style.getPropertyValue(`--${name}`)));
      this.gl.clearColor(...wash, 1);
      this.world = new OGL.Transform();
      this.middle = null;
      this.labels = [];
      this.balls = [];
      this.pins.replaceChildren();
      if (scene.surfaces) {
        this.middle = this.mesh(this.points.midthickness, this.index, this.colors());
        if (this.shows("interior")) this.drawLattice("interior", [0.0, 0.47, 0.35]);
        if (this.shows("exterior")) this.drawLattice("exterior", [0.69, 0.27, 0.54]);
        if (this.shows("boundaries")) {
          EDGES.forEach((text, n) => {
            const line = this.row("midthickness", n ? scene.shape[0] - 1 : 0);
            const { points, index } = tube(line, 0.16);
            this.mesh(points, index, n ? [0.84, 0.37, 0.0] : ink);
            this.label(line[Math.floor(line.length / 2)], text);
          });
          for (const j of scene.ends) {
            const line = Array.from({ length: scene.shape[0] }, (_, i) => this.row("midthickness", i)[j]);
            const { points, index } = tube(line, 0.09);
            this.mesh(points, index, [0.63, 0.07, 0.09]);
          }
        }
        if (this.shows("planes")) scene.planes.forEach((plane) => this.drawPlane(plane));
      } else this.mesh(this.body, scene.body.triangles, GRAY, { opacity: 0.62 });
      if (this.shows("findings")) {
        for (const finding of scene.findings) {
          const { points, index } = ball(toScene(finding.point), 0.55);
          // Inside a body it is drawn over what covers it.
          const over = scene.surfaces ? {} : { depthTest: false, order: 1 };
          const drawn = this.mesh(points, index, KINDS[finding.kind], { flatness: 0.3, ...over });
          this.balls.push(Object.assign(drawn, { finding }));
          const pin = this.label(toScene(finding.point), String(finding.number), "button");
          pin.className = finding.kind;
          pin.title = finding.message;
          pin.setAttribute("aria-label", `Point ${finding.number}, ${finding.kind}: ${finding.message}`);
          pin.addEventListener("click", () => this.open(finding));
        }
      }
      this.markNode();
    }

    // Lines leave the colors between them as they are, which a veil would not.
    drawLattice(name, color) {
      const [nx, ny] = this.scene.shape, from = this.points[name], known = (p) => p.every(Number.isFinite);
      const at = (i, j) => Array.from(from.slice(3 * (i * ny + j), 3 * (i * ny + j) + 3));
      const every = (n) => Array.from({ length: n }, (_, k) => k);
      const lines = every(nx).filter((i) => i % 5 === 0).map((i) => every(ny).map((j) => at(i, j)));
      lines.push(...every(ny).filter((j) => j % 4 === 0).map((j) => every(nx).map((i) => at(i, j))));
      for (const line of lines) {
        const { points, index } = tube(line.filter(known), 0.05, 5);
        this.mesh(points, index, color, { flatness: 0.7 });
      }
    }

    drawPlane({ point, normal, end }) {
      const c = new OGL.Vec3(...toScene(point)), n = new OGL.Vec3(...toScene(normal)).normalize();
      const u = new OGL.Vec3(1, 0, 0).cross(n).normalize(), v = new OGL.Vec3().cross(n, u), reach = 0.55 * this.radius;
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([p, q]) => [
        c.x + reach * (p * u.x + q * v.x), c.y + reach * (p * u.y + q * v.y), c.z + reach * (p * u.z + q * v.z)]);
      const { points, index } = tube([...corners, corners[0]], 0.09);
      this.mesh(points, index, [0.63, 0.07, 0.09], { flatness: 1 });
      this.label(corners.reduce((high, corner) => (corner[1] > high[1] ? corner : high)), ENDS[end]);
    }

    // A name beside a point of the scene.
    label(point, textContent, tag = "span") {
      const element = Object.assign(document.createElement(tag), { textContent });
      if (tag === "button") element.type = "button";
      this.pins.append(element);
      this.labels.push({ point, element });
      return element;
    }

    // The list says what is wrong at a point.
    open({ number }) {
      const entry = document.getElementById(`${this.root.dataset.key.replace(/view$/, "status")}-${this.scene.side}-${number}`);
      if (!entry) return;
      for (let up = entry; up; up = up.parentElement) if (up.tagName === "DETAILS") up.open = true;
      entry.scrollIntoView({ block: "start" });
      (entry.querySelector("summary") || entry).focus({ preventScroll: true });
    }

    markNode() {
      if (this.pin) this.pin.setParent(null);
      this.pin = null;
      if (!this.node || !this.renderer) return;
      const n = 3 * (this.node[0] * this.scene.shape[1] + this.node[1]);
      const { points, index } = ball(Array.from(this.points.midthickness.slice(n, n + 3)), 0.42);
      this.pin = this.mesh(points, index, [1, 1, 1], { flatness: 0.6 });
      const rim = ball(Array.from(this.points.midthickness.slice(n, n + 3)), 0.55);
      const outer = this.mesh(rim.points, rim.index, [0.1, 0.1, 0.1], { opacity: 0.35, flatness: 1 });
      outer.setParent(this.pin);
    }

    resize() {
      if (!this.renderer) return;
      const { clientWidth: width, clientHeight: height } = this.root.querySelector(".scene");
      this.renderer.setSize(width, height);
      this.solid.style.width = this.solid.style.height = "100%";
      this.camera.perspective({ aspect: width / height });
    }

    frame(always = false) {
      const box = this.root.getBoundingClientRect();
      if (!this.world || (!always && (box.bottom < 0 || box.top > window.innerHeight))) return;
      this.orbit.update();
      this.renderer.render({ scene: this.world, camera: this.camera });
      this.placeLetters();
      for (const { point, element } of this.labels) {
        const v = new OGL.Vec3(...point);
        this.camera.project(v);
        element.style.left = `${50 * (v.x + 1)}%`;
        element.style.top = `${50 * (1 - v.y)}%`;
      }
    }

    // Paper has the view as it is now: browsers do not print WebGL.
    still() {
      this.frame(true);
      const picture = this.root.querySelector(".still"), { width, height } = this.solid, context = picture.getContext("2d");
      Object.assign(picture, { width, height });
      context.drawImage(this.solid, 0, 0);
      const dpr = width / Math.max(1, this.root.querySelector(".scene").clientWidth);
      Object.assign(context, { font: `600 ${13 * dpr}px system-ui, sans-serif`, textAlign: "center", textBaseline: "middle", lineWidth: 3 * dpr, strokeStyle: "#fff", fillStyle: "#1d2329" });
      for (const element of this.root.querySelectorAll(".compass span, .pins *")) {
        const [x, y] = [element.style.left, element.style.top].map((share) => parseFloat(share) / 100);
        context.strokeText(element.textContent, x * width, y * height);
        context.fillText(element.textContent, x * width, y * height);
      }
    }

    placeLetters() {
      const compass = this.root.querySelector(".compass");
      const ends = { R: [1, 0, 0], L: [-1, 0, 0], S: [0, 1, 0], I: [0, -1, 0], A: [0, 0, -1], P: [0, 0, 1] };
      if (!compass.children.length) {
        compass.append(...Object.keys(ends).map((letter) => Object.assign(document.createElement("span"), { textContent: letter })));
      }
      Object.values(ends).forEach((d, n) => {
        const v = new OGL.Vec3(...this.center.map((c, k) => c + (this.half[k] + 2.5) * d[k]));
        this.camera.project(v);
        compass.children[n].style.left = `${50 * (v.x + 1)}%`;
        compass.children[n].style.top = `${50 * (1 - v.y)}%`;
      });
    }

    pickAt(event) {
      const box = this.solid.getBoundingClientRect();
      this.raycast.castMouse(this.camera, [2 * ((event.clientX - box.left) / box.width) - 1, 1 - 2 * ((event.clientY - box.top) / box.height)]);
      const seen = this.middle ? [this.middle, ...this.balls] : this.balls;
      const [hit] = this.raycast.intersectMeshes(seen, { cullFace: false, includeUV: false, includeNormal: false });
      if (!hit) return;
      if (hit.finding) { this.open(hit.finding); return; }
      const p = hit.hit.point, points = this.points.midthickness;
      let best = 0, least = Infinity;
      for (let n = 0; n < points.length; n += 3) {
        const d = Math.hypot(points[n] - p.x, points[n + 1] - p.y, points[n + 2] - p.z);
        if (d < least) [least, best] = [d, n / 3];
      }
      const ny = this.scene.shape[1];
      this.pick(Math.floor(best / ny), best % ny);
    }

    pick(i, j) {
      this.node = [i, j];
      this.markNode();
      this.drawFlat();
      this.tell();
    }

    tell() {
      const scene = this.scene, [i, j] = this.node, n = i * scene.shape[1] + j;
      const word = (name) => {
        const value = scene.maps[name][n], scale = this.scales[name];
        return value === null ? "n/a" : `${value.toFixed(scale.digits)} ${scale.unit}`;
      };
      const place = scene.surfaces.midthickness.slice(3 * n, 3 * n + 3);
      const rows = [
        ["Node", `x ${i + 1}, y ${j + 1}`], ["Thickness", word("thickness")], ["Mean curvature", word("curvature")],
        ["Subfield", scene.subfield[n] < 0 ? "n/a" : scene.subfields[scene.subfield[n]].name],
        ["RAS", `${place.map((v) => v.toFixed(1)).join(", ")} mm`],
        ["Measured", (scene.valid[n] ? "directly" : scene.parts.length ? "no value here" : "filled from neighbors") + (scene.repaired[n] ? ", repaired" : "")],
      ];
      const list = this.root.querySelector(".values");
      list.replaceChildren(...rows.flatMap(([name, text]) => [
        Object.assign(document.createElement("dt"), { textContent: name }), Object.assign(document.createElement("dd"), { textContent: text })]));
    }

    drawFlat() {
      const scene = this.scene, [nx, ny] = scene.shape, width = Math.min(330, this.root.clientWidth);
      const most = scene.parts.length ? 1.25 : Infinity; // with a head: fits beside the view
      const tall = Math.round(width * Math.min(most, scene.extent[1] / scene.extent[0])), dpr = window.devicePixelRatio || 1;
      Object.assign(this.flat, { width: width * dpr, height: tall * dpr });
      Object.assign(this.flat.style, { width: `${width}px`, height: `${tall}px` });
      const context = this.flat.getContext("2d"), w = this.flat.width / nx, h = this.flat.height / ny;
      const colors = this.colors();
      for (let i = 0; i < nx; i++) {
        for (let j = 0; j < ny; j++) {
          context.fillStyle = `rgb(${colors[i * ny + j].map((v) => Math.round(255 * v)).join(" ")})`;
          context.fillRect(Math.floor(i * w), Math.floor((ny - 1 - j) * h), Math.ceil(w) + 1, Math.ceil(h) + 1);
        }
      }
      context.lineWidth = 1.2 * dpr;
      context.beginPath();
      for (let i = 0; i < nx; i++) {
        for (let j = 0; j < ny; j++) {
          const own = scene.subfield[i * ny + j], x = i * w, y = (ny - 1 - j) * h;
          const known = (n) => !scene.parts.length || (scene.valid[n] && scene.valid[i * ny + j]);
          if (i + 1 < nx && known((i + 1) * ny + j) && scene.subfield[(i + 1) * ny + j] !== own) { context.moveTo(x + w, y); context.lineTo(x + w, y + h); }
          if (j + 1 < ny && known(i * ny + j + 1) && scene.subfield[i * ny + j + 1] !== own) { context.moveTo(x, y); context.lineTo(x + w, y); }
        }
      }
      context.stroke();
      context.setLineDash([6 * dpr, 3 * dpr]);
      context.beginPath();
      for (const j of scene.ends) { context.moveTo(0, (ny - 0.5 - j) * h); context.lineTo(nx * w, (ny - 0.5 - j) * h); }
      context.stroke();
      context.setLineDash([]);
      context.font = `${12 * dpr}px sans-serif`;
      for (const [name, first, last] of scene.parts) {
        const at = [4 * dpr, (ny - 0.5 - (first + last) / 2) * h];
        context.strokeStyle = "#fff";
        context.lineWidth = 3 * dpr;
        context.strokeText(name, ...at);
        context.fillStyle = "#000";
        context.fillText(name, ...at);
        context.strokeStyle = "#000";
      }
      if (this.node) {
        const [i, j] = this.node, x = (i + 0.5) * w, y = (ny - 0.5 - j) * h;
        for (const [size, style] of [[3 * dpr, "#fff"], [1.4 * dpr, "#000"]]) {
          context.lineWidth = size;
          context.strokeStyle = style;
          context.beginPath();
          context.arc(x, y, 6 * dpr, 0, 2 * Math.PI);
          context.stroke();
        }
        context.strokeStyle = "#000";
      }
      this.drawBar();
    }

    drawBar() {
      const bar = this.root.querySelector(".bar"), kind = this.coloring, scale = this.scales[kind];
      const make = (name, properties, ...children) => {
        const element = Object.assign(document.createElement(name), properties);
        element.append(...children);
        return element;
      };
      if (kind === "subfield") {
        bar.replaceChildren(make("ul", { className: "legend" }, ...this.scene.subfields.map(({ name, color }) => {
          const swatch = make("span", { className: "swatch" });
          swatch.style.cssText = `background:${color};opacity:1`;
          return make("li", {}, swatch, name);
        })));
        bar.setAttribute("aria-label", "colors of subfields");
        return;
      }
      const colors = (scale || this.scales.thickness).colors;
      const words = scale ? [`≤ ${scale.low.toFixed(scale.digits)}`, `${scale.title.toLowerCase()} [${scale.unit}]`, `≥ ${scale.high.toFixed(scale.digits)}`]
        : kind === "x" ? ["medial", "", "lateral"] : ["posterior", "", "anterior"];
      const gradient = make("div", { className: "gradient" });
      gradient.style.background = `linear-gradient(to right,${colors.join(",")})`;
      bar.replaceChildren(gradient, make("p", { className: "ends" }, ...words.map((textContent) => make("span", { textContent }))));
      bar.setAttribute("aria-label", `color bar: ${words.join(" ")}`);
    }
  }

  for (const root of document.querySelectorAll(".viewer")) root.viewer = new Viewer(root);
})();
