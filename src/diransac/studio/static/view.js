import { button, h, number, numbers, put } from "./page.js";

// Bodies in three dimensions: shapes and their places over time as MuJoCo has computed them, drawn by WebGL.
const VERTEX = `attribute vec3 p; attribute vec3 n; uniform mat4 camera; uniform mat3 turn; uniform vec3 at; varying vec3 normal;
void main() { normal = turn * n; gl_Position = camera * vec4(turn * p + at, 1.0); }`;
const FRAGMENT = `precision mediump float; varying vec3 normal; uniform vec4 color;
void main() { float light = 0.55 + 0.45 * dot(normalize(normal), normalize(vec3(0.4, 0.3, 0.85))); gl_FragColor = vec4(color.rgb * light * color.a, color.a); }`;
const LINE = `attribute vec3 p; uniform mat4 camera; void main() { gl_Position = camera * vec4(p, 1.0); }`;
const FLAT = `precision mediump float; uniform vec4 color; void main() { gl_FragColor = vec4(color.rgb * color.a, color.a); }`;
const COLORS = [
  [0.29, 0.6, 0.84, 1],
  [0.93, 0.5, 0.2, 0.55],
];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const unit = (a) => a.map((x) => x / Math.hypot(...a));

export class View {
  constructor() {
    Object.assign(this, { yaw: 0.9, pitch: 0.35, zoom: 1, frame: 0, playing: false });
    this.canvas = h("canvas", { tabIndex: 0, "aria-label": "The machine; drag to turn, wheel to zoom" });
    this.slider = h("input", {
      type: "range",
      min: 0,
      value: 0,
      "aria-label": "time",
      oninput: () => {
        this.frame = +this.slider.value;
        this.playing = false;
        this.draw();
      },
    });
    this.button = button("Play", () => this.play());
    this.label = h("span.how");
    this.controls = h(".row", this.button, this.slider, this.label);
    this.element = h("div", h(".view", this.canvas), this.controls);
  }

  // A view of a scene in a place, in which it follows another one.
  static show(place, query, before) {
    before?.stop();
    const view = new View();
    view
      .load(query)
      .then(() => {
        if (view.ended) return;
        put(place, view.element);
        view.start();
      })
      .catch((error) => put(place, h("p.how", `No view: ${error.message}`)));
    return view;
  }

  async load(query) {
    const content = await numbers("scene", query),
      length = new DataView(content).getUint32(0, true);
    this.head = JSON.parse(new TextDecoder().decode(new Uint8Array(content, 4, length)));
    const all = new Float32Array(content, 4 + length),
      gl = (this.gl = this.canvas.getContext("webgl", { antialias: true, premultipliedAlpha: true }));
    if (!gl) throw new Error("this browser has no WebGL");
    let at = 0;
    this.shapes = this.head.shapes.map((shape) => {
      const buffer = gl.createBuffer(),
        part = all.subarray(at, at + 6 * shape.count);
      at += part.length;
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, part, gl.STATIC_DRAW);
      return {
        ...shape,
        buffer,
        reach: part.reduce((most, x, k) => (k % 6 < 3 ? Math.max(most, Math.abs(x)) : most), 0),
      };
    });
    const n = this.head.time.length,
      stride = 12 * this.shapes.length;
    this.places = Array.from({ length: this.head.motions }, (_, k) =>
      all.subarray(at + k * n * stride, at + (k + 1) * n * stride),
    );
    this.prepare(n, stride);
  }

  prepare(n, stride) {
    const low = [Infinity, Infinity, Infinity],
      high = low.map((x) => -x);
    for (let i = 0; i < n; i += Math.ceil(n / 60)) {
      this.shapes.forEach(({ reach }, k) =>
        [0, 1, 2].forEach((j) => {
          const x = this.places[0][i * stride + 12 * k + 9 + j];
          low[j] = Math.min(low[j], x - reach);
          high[j] = Math.max(high[j], x + reach);
        }),
      );
    }
    const machine = this.extent(0),
      way = Math.max(...high.map((x, j) => x - low[j]), 0.1);
    this.follows = way > 5 * machine.size;
    this.size = this.follows ? 1.5 * machine.size : way;
    this.center = this.follows ? machine.center : low.map((x, j) => (x + high[j]) / 2);
    this.floor = this.follows ? machine.center[2] - machine.size : low[2];
    const { gl } = this,
      link = (...sources) => {
        const program = gl.createProgram();
        sources.forEach((source, k) => {
          const shader = gl.createShader(k ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
          gl.shaderSource(shader, source);
          gl.compileShader(shader);
          gl.attachShader(program, shader);
        });
        gl.linkProgram(program);
        return program;
      };
    this.solid = link(VERTEX, FRAGMENT);
    this.thin = link(LINE, FLAT);
    const step = 10 ** Math.floor(Math.log10(3 * this.size)) / 2,
      reach = 12 + Math.ceil(Math.min(way, 30 * step) / step),
      lines = [],
      [cx, cy] = this.center.map((x) => Math.round(x / step) * step);
    const corner = (x, y) => lines.push(cx + x * step, cy + y * step, this.floor);
    // Short pieces, of which those behind the camera are simply not there.
    for (let k = -reach; k <= reach; k += 1) {
      for (let j = -reach; j < reach; j += 1) {
        corner(k, j);
        corner(k, j + 1);
        corner(j, k);
        corner(j + 1, k);
      }
    }
    this.grid = gl.createBuffer();
    this.lines = lines.length / 3;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.grid);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(lines), gl.STATIC_DRAW);
    this.slider.max = n - 1;
    this.controls.hidden = n < 2;
    if (this.head.motions > 1)
      this.controls.append(h("span.key", "measured"), h("span.key.second", "predicted"));
  }

  extent(frame) {
    const moving = this.shapes.map((x, k) => [x, k]).filter(([x]) => x.moves),
      chosen = moving.length ? moving : this.shapes.map((x, k) => [x, k]);
    const at = (k, j) => this.places[0][(frame * this.shapes.length + k) * 12 + 9 + j];
    const center = [0, 1, 2].map((j) => chosen.reduce((sum, [, k]) => sum + at(k, j) / chosen.length, 0));
    const reaches = chosen.map(([x, k]) => x.reach + Math.hypot(...center.map((c, j) => at(k, j) - c)));
    return { center, size: 2 * Math.max(0.05, ...reaches) };
  }

  start() {
    const { canvas } = this;
    let from = null;
    canvas.addEventListener("pointerdown", (event) => {
      from = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!from) return;
      this.turn((event.clientX - from[0]) / 150, (event.clientY - from[1]) / 150);
      from = [event.clientX, event.clientY];
    });
    canvas.addEventListener("pointerup", () => (from = null));
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom = Math.min(Math.max(this.zoom * (event.deltaY > 0 ? 1.1 : 0.9), 0.05), 8);
        this.draw();
      },
      { passive: false },
    );
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[
        event.key
      ];
      if (step) {
        this.turn(...step);
        event.preventDefault();
      }
    });
    new ResizeObserver(() => this.draw()).observe(canvas);
    this.draw();
  }

  turn(x, y) {
    this.yaw -= x;
    this.pitch = Math.min(Math.max(this.pitch + y, -1.5), 1.5);
    this.draw();
  }

  play() {
    this.playing = !this.playing;
    put(this.button, this.playing ? "Pause" : "Play");
    const { time } = this.head,
      last = time.length - 1;
    if (this.frame >= last) this.frame = 0;
    const begin = performance.now() / 1000 - (time[this.frame] - time[0]);
    const next = () => {
      if (!this.playing || !this.canvas.isConnected) {
        this.playing = false;
        put(this.button, "Play");
        return;
      }
      const t = time[0] + performance.now() / 1000 - begin;
      while (this.frame < last && time[this.frame + 1] <= t) this.frame += 1;
      if (this.frame >= last) this.playing = false;
      this.slider.value = this.frame;
      this.draw();
      requestAnimationFrame(next);
    };
    requestAnimationFrame(next);
  }

  stop() {
    this.playing = false;
    this.ended = true;
    this.gl?.getExtension("WEBGL_lose_context")?.loseContext();
  }

  camera(wide, tall) {
    const distance = 1.7 * this.size * this.zoom,
      f = 1.9,
      c = Math.cos(this.pitch);
    const back = [c * Math.cos(this.yaw), c * Math.sin(this.yaw), Math.sin(this.pitch)],
      eye = this.center.map((x, j) => x + distance * back[j]);
    const right = unit(cross([0, 0, 1], back)),
      up = cross(back, right),
      near = distance / 100,
      far = distance * 20;
    const rows = [
      right.map((x) => (x * f * tall) / wide),
      up.map((x) => x * f),
      back.map((x) => (x * (far + near)) / (near - far)),
      back.map((x) => -x),
    ];
    const shifts = [
      -dot(rows[0], eye),
      -dot(rows[1], eye),
      -dot(rows[2], eye) + (2 * far * near) / (near - far),
      dot(back, eye),
    ];
    return new Float32Array([0, 1, 2].flatMap((j) => rows.map((x) => x[j])).concat(shifts));
  }

  draw() {
    const { gl, canvas } = this,
      scale = devicePixelRatio || 1;
    if (!canvas.clientWidth) return;
    if (this.follows) this.center = this.extent(this.frame).center;
    canvas.width = canvas.clientWidth * scale;
    canvas.height = canvas.clientHeight * scale;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const camera = this.camera(canvas.width, canvas.height),
      set = (program, name) => gl.getUniformLocation(program, name);
    gl.useProgram(this.thin);
    gl.uniformMatrix4fv(set(this.thin, "camera"), false, camera);
    gl.uniform4f(set(this.thin, "color"), 0.5, 0.55, 0.6, 0.35);
    this.bind(this.thin, this.grid, 3, ["p"]);
    gl.drawArrays(gl.LINES, 0, this.lines);
    gl.useProgram(this.solid);
    gl.uniformMatrix4fv(set(this.solid, "camera"), false, camera);
    const stride = 12 * this.shapes.length;
    this.places.forEach((places, motion) =>
      this.shapes.forEach((shape, k) => {
        if (motion && !shape.moves) return;
        const at = this.frame * stride + 12 * k,
          r = places.subarray(at, at + 9),
          plain = shape.color.every((x) => Math.abs(x - 0.5) < 0.01);
        const color = motion || (plain && shape.moves) ? COLORS[motion] : [...shape.color, 1];
        gl.uniform4fv(set(this.solid, "color"), color);
        gl.uniformMatrix3fv(
          set(this.solid, "turn"),
          false,
          new Float32Array([r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]]),
        );
        gl.uniform3fv(set(this.solid, "at"), places.subarray(at + 9, at + 12));
        this.bind(this.solid, shape.buffer, 6, ["p", "n"]);
        gl.drawArrays(gl.TRIANGLES, 0, shape.count);
      }),
    );
    put(this.label, `${number(this.head.time[this.frame], 5)} s`);
  }

  bind(program, buffer, width, names) {
    const { gl } = this;
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    names.forEach((name, k) => {
      const place = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, 3, gl.FLOAT, false, 4 * width, 12 * k);
    });
  }
}
