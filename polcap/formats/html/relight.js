'use strict';
// The maps under a light from the direction of the pointer, and the mesh, which the pointer turns.
const FLAT = `attribute vec2 corner; varying vec2 at;
void main() { at = vec2(corner.x, 1.0 - corner.y); gl_Position = vec4(2.0 * corner - 1.0, 0.0, 1.0); }`;
const SOLID = `attribute vec3 position; attribute vec2 uv; uniform mat4 view; uniform vec3 low, extent;
varying vec2 at; varying vec3 point;
void main() { at = uv; point = low + extent * position; gl_Position = view * vec4(point, 1.0); }`;
const PIXEL = `
uniform sampler2D shape, body, gloss;  // normal and roughness; root of the diffuse albedo and matte; root of F0
uniform vec3 light, eye; uniform vec2 size, center; uniform float focal, ior, exposure, top; uniform int mode;
varying vec2 at;
#ifdef SOLID
varying vec3 point;
#endif
void main() {
  vec4 inner = texture2D(body, at);
#ifndef SOLID
  if (inner.a == 0.0) { gl_FragColor = vec4(0.0, 0.0, 0.0, 1.0); return; }
#endif
  vec4 outer = texture2D(shape, at);
#ifdef SOLID
  vec3 v = normalize(eye - point);
#else
  vec2 pixel = at * size - 0.5 - center;
  vec3 v = normalize(vec3(-pixel.x, pixel.y, focal));
#endif
  vec3 n = normalize(outer.rgb * 2.0 - 1.0), l = light == vec3(0.0) ? v : normalize(light);
  if (mode == 2) { gl_FragColor = vec4(outer.rgb, 1.0); return; }
  bool clay = mode == 1;
  vec3 root = texture2D(gloss, at).rgb;
  vec3 diffuse = clay ? vec3(0.6) : inner.rgb * inner.rgb, specular = clay ? vec3(0.0) : top * root * root;
  vec3 seen = shade(n, v, l, diffuse, specular, clay ? 1.0 : max(outer.a, 0.02), ior);
#ifdef SOLID
  seen += 0.04 * diffuse;  // so that the dark side differs from the backdrop
  if (!gl_FrontFacing) seen = vec3(0.02);
#else
  seen *= inner.a;
#endif
  gl_FragColor = vec4(encoded(seen * (clay ? 1.0 : exposure)), 1.0);
}`;

class Painter {
  constructor(canvas, vertex, prefix, solid) {
    this.solid = solid;
    this.gl = canvas.getContext('webgl', { antialias: solid, alpha: false, depth: solid });
    if (!this.gl) throw new Error('no WebGL');
    const gl = this.gl;
    this.program = gl.createProgram();
    this.attach(gl.VERTEX_SHADER, vertex);
    this.attach(gl.FRAGMENT_SHADER, prefix + DATA.law + PIXEL);
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.program));
    gl.useProgram(this.program);
    this.places = {};
  }

  attach(kind, source) {
    const gl = this.gl, shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(this.program, shader);
  }

  place(name) { return this.places[name] ??= this.gl.getUniformLocation(this.program, name); }

  texture(slot, name, source) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + slot);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, source.width, source.height, 0, gl.RGBA, gl.UNSIGNED_BYTE, source.data);
    const filter = this.solid ? gl.LINEAR : gl.NEAREST;  // the flat picture has the pixels of the maps
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    for (const end of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, end, filter);
    gl.uniform1i(this.place(name), slot);
  }

  maps(sources) {
    const gl = this.gl, { size, center, focal, ior, exposure, top } = DATA.view;
    Object.entries(sources).forEach(([name, source], slot) => this.texture(slot, name, source));
    gl.uniform2f(this.place('size'), ...size);
    gl.uniform2f(this.place('center'), ...center);
    for (const [name, value] of Object.entries({ focal, ior, exposure, top })) gl.uniform1f(this.place(name), value);
  }

  buffer(name, width, kind, normalized, data) {
    const gl = this.gl, at = gl.getAttribLocation(this.program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, width, kind, normalized, 0, 0);
  }
}

class Redraw {  // draws at most once a frame
  constructor(draw) { this.draw = draw; this.due = false; }

  ask() {
    if (this.due) return;
    this.due = true;
    requestAnimationFrame(() => { this.due = false; this.draw(); });
  }
}

const BUDGET = 25;  // ms for a picture, so that 30 are drawn in a second
const REST = 250;  // ms without a move, after which the picture is drawn at its full size
const ARROWS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };

class Relight {
  constructor(canvas, sources) {
    this.canvas = canvas;
    this.light = DATA.view.light || [0, 0, 0];  // none: the flash, next to the lens
    this.size = DATA.view.size;
    this.share = 1;  // of the picture's sides that is drawn while the light moves
    canvas.style.aspectRatio = this.size.join(' / ');
    this.painter = new Painter(canvas, FLAT, '', false);
    this.painter.maps(sources);
    this.painter.buffer('corner', 2, this.painter.gl.FLOAT, false, new Float32Array([0, 0, 1, 0, 0, 1, 1, 1]));
    this.redraw = new Redraw(() => this.follow());
    for (const kind of ['pointermove', 'pointerdown']) canvas.addEventListener(kind, (event) => this.move(event));
    canvas.addEventListener('keydown', (event) => this.step(event));
    this.draw();
  }

  move(event) {
    const place = this.canvas.getBoundingClientRect();
    this.aim((event.clientX - place.left) / place.width * 2 - 1, 1 - (event.clientY - place.top) / place.height * 2);
  }

  aim(x, y) {  // −1…1 across the picture: a hemisphere of directions
    const far = Math.hypot(x, y), most = 0.97, shrink = far > most ? most / far : 1;
    this.light = [x * shrink, y * shrink, Math.sqrt(1 - (Math.min(far, most)) ** 2)];
    this.redraw.ask();
  }

  step(event) {
    const by = ARROWS[event.key];
    if (!by) return;
    event.preventDefault();
    this.aim(this.light[0] + by[0], this.light[1] + by[1]);
  }

  follow() {  // while the light moves, draws the largest picture that takes less than BUDGET ms
    const start = performance.now(), gl = this.painter.gl;
    this.draw(this.share);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));  // waits for the drawing
    const whole = (performance.now() - start) / this.share ** 2;
    this.share = [1, 1 / 2].find((share) => whole * share ** 2 < BUDGET) ?? 1 / 4;
    clearTimeout(this.rest);
    this.rest = setTimeout(() => this.draw(), REST);
  }

  draw(share = 1) {
    const gl = this.painter.gl, [width, height] = this.size.map((side) => Math.ceil(side * share));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      [this.canvas.width, this.canvas.height] = [width, height];
    }
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.uniform3f(this.painter.place('light'), ...this.light);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
}

class Solid {
  constructor(canvas, sources, mesh) {
    this.canvas = canvas;
    this.turn = [0.35, 0.15];  // rad about the upright axis, then up
    this.near = 1;  // distance of the eye, relative to that at which the mesh fills the picture
    this.mode = 0;
    this.pointers = new Map();
    this.spread = 0;  // distance of two fingers, px
    [canvas.width, canvas.height] = [960, 600];
    const painter = this.painter = new Painter(canvas, SOLID, '#define SOLID\n', true), gl = painter.gl;
    if (mesh.wide && !gl.getExtension('OES_element_index_uint')) throw new Error('no 32-bit indices');
    painter.maps(sources);
    painter.buffer('position', 3, gl.UNSIGNED_SHORT, true, mesh.position);
    painter.buffer('uv', 2, gl.UNSIGNED_SHORT, true, mesh.uv);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, mesh.faces, gl.STATIC_DRAW);
    gl.uniform3f(painter.place('low'), ...mesh.low);
    gl.uniform3f(painter.place('extent'), ...mesh.extent);
    gl.enable(gl.DEPTH_TEST);
    this.count = mesh.faces.length;
    this.middle = mesh.low.map((low, k) => low + mesh.extent[k] / 2);
    this.radius = Math.hypot(...mesh.extent) / 2;
    this.redraw = new Redraw(() => this.draw());
    this.listen();
    this.draw();
  }

  listen() {
    const { canvas } = this;
    canvas.addEventListener('pointerdown', (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
      this.spread = 0;
    });
    for (const kind of ['pointerup', 'pointercancel']) {
      canvas.addEventListener(kind, (event) => { this.pointers.delete(event.pointerId); this.spread = 0; });
    }
    canvas.addEventListener('pointermove', (event) => this.drag(event));
    canvas.addEventListener('wheel', (event) => { event.preventDefault(); this.zoom(event.deltaY / 600); },
      { passive: false });
    canvas.addEventListener('keydown', (event) => this.step(event));
    for (const button of document.querySelectorAll('[data-mode]')) {
      button.addEventListener('click', () => {
        this.mode = Number(button.dataset.mode);
        for (const other of document.querySelectorAll('[data-mode]')) {
          other.setAttribute('aria-pressed', String(other === button));
        }
        this.redraw.ask();
      });
    }
  }

  drag(event) {
    const last = this.pointers.get(event.pointerId);
    if (!last) return;
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    if (this.pointers.size === 2) {
      const [a, b] = [...this.pointers.values()], spread = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (this.spread) this.zoom(Math.log(this.spread / spread));
      this.spread = spread;
      return;
    }
    this.rotate((event.clientX - last[0]) * 0.008, (event.clientY - last[1]) * 0.008);
  }

  step(event) {
    const by = ARROWS[event.key];
    if (!by) return;
    event.preventDefault();
    this.rotate(...by);
  }

  rotate(right, up) {
    const within = (x, most) => Math.max(-most, Math.min(most, x));
    const around = this.turn[0] + right;
    this.turn = [DATA.mesh.closed ? around : within(around, 1.5), within(this.turn[1] + up, 1.4)];
    this.redraw.ask();
  }

  zoom(by) {
    this.near = Math.max(0.3, Math.min(3, this.near * Math.exp(by)));
    this.redraw.ask();
  }

  draw() {
    const gl = this.painter.gl, field = 0.35, [right, up] = this.turn;  // rad, half the field of view
    const [wide, high, deep] = DATA.mesh.extent, aspect = this.canvas.width / this.canvas.height;
    const away = this.near * 0.57 * Math.max(high, wide / aspect) / Math.tan(field) + deep / 2;
    const [ca, sa, cb, sb] = [Math.cos(right), Math.sin(right), Math.cos(up), Math.sin(up)];
    // rows of the turn: about y, then about x
    const rows = [[ca, 0, sa], [sb * sa, cb, -sb * ca], [-cb * sa, sb, cb * ca]];
    const moved = rows.map((row) => -row.reduce((sum, x, k) => sum + x * this.middle[k], 0));
    moved[2] -= away;
    const near = Math.max(away - 2 * this.radius, away * 0.02), far = away + 2 * this.radius, f = 1 / Math.tan(field);
    const view = new Float32Array(16);
    for (let k = 0; k < 4; k++) {
      const [x, y, z] = k < 3 ? rows.map((row) => row[k]) : moved, w = k < 3 ? 0 : 1;
      view.set([f / aspect * x, f * y, (far + near) / (near - far) * z + 2 * far * near / (near - far) * w, -z], 4 * k);
    }
    const eye = [0, 1, 2].map((k) => -rows.reduce((sum, row, j) => sum + row[k] * moved[j], 0));
    // the light moves with the eye: above it and to the left
    const light = [0, 1, 2].map((k) => -0.45 * rows[0][k] + 0.5 * rows[1][k] + 0.75 * rows[2][k]);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0.05, 0.05, 0.06, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(this.painter.place('view'), false, view);
    gl.uniform3f(this.painter.place('eye'), ...eye);
    gl.uniform3f(this.painter.place('light'), ...light);
    gl.uniform1i(this.painter.place('mode'), this.mode);
    gl.drawElements(gl.TRIANGLES, this.count, this.painter.gl.UNSIGNED_INT, 0);
  }
}

async function unpacked(text) {
  const stream = new Blob([bytes(text)]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Response(stream).arrayBuffer();
}

async function meshed({ position, uv, faces, low, extent }) {
  const [p, t, f] = await Promise.all([position, uv, faces].map(unpacked));
  const index = new Int32Array(f);  // differences
  for (let k = 1; k < index.length; k++) index[k] += index[k - 1];
  return { position: new Uint16Array(p), uv: new Uint16Array(t), faces: new Uint32Array(index.buffer), low, extent, wide: true };
}

// textures of the shader; it squares the roots of linear light, which in 8 bits resolve dark colors
function textures({ normal, diffuse, specular, roughness, matte }) {
  const [n, d, s, r] = [normal, diffuse, specular, roughness].map(pixels), { width, height } = n;
  const opaque = matte && pixels(matte).data;
  const root = Uint8Array.from({ length: 256 }, (_, code) => Math.round(255 * Math.sqrt(linear(code))));
  const [shape, body, gloss] = [0, 1, 2].map(() => ({ data: new Uint8Array(4 * width * height), width, height }));
  for (let k = 0; k < n.data.length; k += 4) {
    const level = LEVELS.viridis.get((r.data[k] << 16) | (r.data[k + 1] << 8) | r.data[k + 2]) ?? 127;
    for (let c = 0; c < 3; c++) {
      shape.data[k + c] = n.data[k + c];
      body.data[k + c] = root[d.data[k + c]];
      gloss.data[k + c] = root[s.data[k + c]];
    }
    shape.data[k + 3] = Math.round(level / 254 * 255);
    body.data[k + 3] = opaque ? opaque[k + 3] : 255;
  }
  return { shape, body, gloss };
}

async function begin() {
  const images = Object.fromEntries(['normal', 'diffuse', 'specular', 'roughness'].map(
    (name) => [name, document.querySelector(`#map-${name} img`)]));
  if (DATA.view.matte) images.matte = Object.assign(new Image(), { src: DATA.view.matte });
  await Promise.all(Object.values(images).map((image) => image.decode()));
  const sources = textures(images);
  if (document.getElementById('relight')) {
    window.relight = new Relight(document.getElementById('relight'), sources);
    document.getElementById('relit').classList.add('live');
  }
  if (DATA.mesh) window.solid = new Solid(document.getElementById('solid'), sources, await meshed(DATA.mesh));
  document.documentElement.dataset.ready = 'yes';
}

if (DATA.view) {
  begin().catch((error) => {
    document.documentElement.dataset.ready = 'no';
    for (const note of document.querySelectorAll('.needs-gl')) note.hidden = false;
    console.warn(`polcap: no moving light here: ${error.message}`);
  });
}
