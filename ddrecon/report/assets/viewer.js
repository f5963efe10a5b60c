// A volume as smoke, seen through: a ray for each pixel, in WebGL 2. Drag turns, the wheel zooms.
"use strict";

const VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler3D;
uniform sampler3D density, values;   // both as displayed; density says what is seen
uniform vec3 eye, right, up, forward, half_box, light;
uniform vec2 pixels;
uniform float tangent, opacity, low, high;
uniform int steps, palette;          // palette 0: lit smoke, 1: colors for values, 2: values are colors
out vec4 color;

vec3 place(vec3 point) { return point / (2.0 * half_box) + 0.5; }

float matter(vec3 point) {
  float shown = texture(density, place(point)).r;
  float part = clamp((shown - low) / max(high - low, 1e-3), 0.0, 1.0);
  return part * part * opacity;      // about linear again: shown is nearly a square root
}

vec2 cross_box(vec3 from, vec3 way) {
  vec3 one = (-half_box - from) / way, other = (half_box - from) / way;
  vec3 near = min(one, other), far = max(one, other);
  return vec2(max(max(near.x, near.y), max(near.z, 0.0)), min(min(far.x, far.y), far.z));
}

vec3 heat(float v) {
  vec3 a = vec3(0.04, 0.03, 0.18), b = vec3(0.47, 0.11, 0.43), c = vec3(0.90, 0.36, 0.19);
  vec3 d = vec3(0.99, 0.80, 0.35), e = vec3(0.99, 1.0, 0.85);
  v = clamp(v, 0.0, 1.0) * 4.0;
  return v < 1.0 ? mix(a, b, v) : v < 2.0 ? mix(b, c, v - 1.0)
    : v < 3.0 ? mix(c, d, v - 2.0) : mix(d, e, v - 3.0);
}

float noise(vec2 at) { return fract(52.9829189 * fract(dot(at, vec2(0.06711056, 0.00583715)))); }

void main() {
  vec2 at = (2.0 * gl_FragCoord.xy - pixels) / pixels.y * tangent;
  vec3 way = normalize(forward + at.x * right + at.y * up);
  vec2 span = cross_box(eye, way);
  vec3 sum = vec3(0.0);
  float clear = 1.0;
  if (span.y > span.x) {
    float size = (span.y - span.x) / float(steps);
    for (int i = 0; i < steps && clear > 0.01; ++i) {
      vec3 point = eye + way * (span.x + (float(i) + noise(gl_FragCoord.xy)) * size);
      float here = matter(point);
      if (here <= 0.0) continue;
      vec3 shade;
      if (palette == 0) {            // what reaches here from the light, in six steps
        float depth = 0.0;
        for (int j = 0; j < 6; ++j) depth += matter(point + light * (float(j) + 0.7) * 0.05) * 0.05;
        shade = vec3(1.0, 0.95, 0.87) * (0.8 * exp(-1.3 * depth) + 0.2 * exp(-0.3 * depth))
          + vec3(0.05, 0.07, 0.11);
      } else {
        vec3 value = texture(values, place(point)).rgb;
        vec3 shown = palette == 1 ? heat(value.r) : value;
        shade = pow(shown, vec3(2.2));
      }
      float kept = exp(-here * size);
      sum += clear * (1.0 - kept) * shade;
      clear *= kept;
    }
  }
  vec3 seen = pow(sum, vec3(1.0 / 2.2));
  color = vec4(seen, max(1.0 - pow(clear, 1.0 / 2.2), max(seen.r, max(seen.g, seen.b))));
}`;

// What all viewers of a page share, so that result and truth turn together.
const sight = { yaw: 0.6, pitch: 0.25, distance: 2.0, opacity: 16, low: 0.03, high: 1, palette: 0, cameras: true };
const viewers = [];

function redrawAll(isMoving = false) {
  for (const viewer of viewers) viewer.request(isMoving);
}

class Viewer {
  // Throws where there is no WebGL 2. `of` is "result" or "truth"; `layers` are behind and before it.
  constructor(canvas, of, layers) {
    this.canvas = canvas;
    this.of = of;
    this.layers = layers;
    this.gl = canvas.getContext("webgl2", { antialias: false });
    if (!this.gl) throw new Error("no WebGL 2");
    this.program = this.link();
    this.textures = {};
    this.pointers = new Map();
    this.listen();
    new ResizeObserver(() => this.request()).observe(canvas);
    viewers.push(this);
  }

  link() {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    return program;
  }

  // Takes the fields of the page; `name` is the one that colors show.
  show(name) {
    const density = fields.get(`${this.of} density`) ?? fields.get(`${this.of} ${name}`);
    const shown = fields.get(`${this.of} ${name}`) ?? density;
    this.upload("density", density);
    this.upload("values", shown);
    this.hasColors = shown.channels === 3;
    this.request();
  }

  upload(slot, field) {
    const { gl } = this;
    const formats = field.channels === 3 ? [gl.RGB8, gl.RGB] : [gl.R8, gl.RED];
    this.textures[slot] ??= gl.createTexture();
    gl.bindTexture(gl.TEXTURE_3D, this.textures[slot]);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage3D(gl.TEXTURE_3D, 0, formats[0], ...field.size, 0, formats[1], gl.UNSIGNED_BYTE, field.bytes);
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(gl.TEXTURE_3D, filter, gl.LINEAR);
    for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R])
      gl.texParameteri(gl.TEXTURE_3D, wrap, gl.CLAMP_TO_EDGE);
  }

  request(isMoving = false) {
    this.isMoving = isMoving;
    this.frame ??= requestAnimationFrame(() => {
      this.frame = undefined;
      if (this.textures.values) this.draw();
    });
  }

  draw() {
    const { gl, canvas } = this;
    const scale = this.isMoving ? 0.6 : Math.min(window.devicePixelRatio, 1.5);
    canvas.width = Math.max(1, canvas.clientWidth * scale);
    canvas.height = Math.max(1, canvas.clientHeight * scale);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.useProgram(this.program);
    const at = (name) => gl.getUniformLocation(this.program, name);
    const longest = Math.max(...world.sides);
    const [camera, tangent] = [this.camera(), 0.36 * Math.max(1, canvas.height / canvas.width)];
    const vectors = { ...camera, half_box: world.sides.map((side) => side / longest / 2) };
    for (const [name, vector] of Object.entries(vectors)) gl.uniform3fv(at(name), vector);
    gl.uniform2f(at("pixels"), canvas.width, canvas.height);
    gl.uniform1f(at("tangent"), tangent);
    for (const name of ["opacity", "low", "high"]) gl.uniform1f(at(name), sight[name]);
    gl.uniform1i(at("steps"), this.isMoving ? 64 : 160);
    gl.uniform1i(at("palette"), sight.palette && this.hasColors ? 2 : sight.palette);
    ["density", "values"].forEach((slot, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_3D, this.textures[slot]);
      gl.uniform1i(at(slot), unit);
    });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    drawAround(this.layers, camera, tangent);
  }

  // Where the eye is and its axes, in boxes.
  camera() {
    const vector = (sideways, upwards, towards) => {
      const result = [0, 0, 0];
      result[(world.up + 2) % 3] = sideways;
      result[world.up] = upwards;
      result[(world.up + 1) % 3] = towards;
      return result;
    };
    const [cy, sy, cp, sp] = [Math.cos(sight.yaw), Math.sin(sight.yaw), Math.cos(sight.pitch), Math.sin(sight.pitch)];
    const away = [sy * cp, sp, cy * cp];
    return {
      eye: vector(...away.map((part) => part * sight.distance)),
      forward: vector(...away.map((part) => -part)),
      right: vector(cy, 0, -sy),
      up: vector(-sy * sp, cp, -cy * sp),
      light: world.light ?? vector(0.45, 0.8, 0.4),
    };
  }

  listen() {
    const { canvas, pointers } = this;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, event);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const other = [...pointers.values()].find((one) => one.pointerId !== event.pointerId);
      const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      if (other) zoom(apart(before) / Math.max(apart(event), 1));
      else turn((before.clientX - event.clientX) * 0.008, (event.clientY - before.clientY) * 0.008);
      pointers.set(event.pointerId, event);
      redrawAll(true);
    });
    for (const kind of ["pointerup", "pointercancel"])
      canvas.addEventListener(kind, (event) => {
        pointers.delete(event.pointerId);
        redrawAll();
      });
    canvas.addEventListener("wheel", (event) => {
      if (isMeantForPage(event, canvas)) return;
      event.preventDefault();
      zoom(Math.exp(event.deltaY * 0.001));
      redrawAll();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
      if (event.key in steps) turn(...steps[event.key]);
      else if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 0.9 : 1.1);
      else return;
      event.preventDefault();
      redrawAll();
    });
  }
}

// Looks from the side where `eye` (x, y, z) is.
function lookFrom(eye) {
  const [sideways, upwards, towards] = [2, 0, 1].map((more) => eye[(world.up + more) % 3]);
  sight.yaw = Math.atan2(sideways, towards);
  sight.pitch = Math.atan2(upwards, Math.hypot(sideways, towards));
}

// Whether the wheel scrolls the page: it turned outside the viewers a moment ago, and these pass by.
// Within a frame that is not seen, so there a viewer must have been clicked.
let lastScroll = -Infinity;
addEventListener("wheel", (event) => {
  if (!event.target.closest("#viewers")) lastScroll = event.timeStamp;
}, { passive: true });

function isMeantForPage(event, canvas) {
  if (document.body.classList.contains("small")) return document.activeElement !== canvas;
  if (event.timeStamp - lastScroll > 300) return false;
  lastScroll = event.timeStamp;
  return true;
}

function turn(yaw, pitch) {
  sight.yaw += yaw;
  sight.pitch = Math.min(1.55, Math.max(-1.55, sight.pitch + pitch));
}

function zoom(factor) {
  const farthest = Math.max(4, ...world.cameras.map(({ corners }) => Math.hypot(...corners[0])));
  sight.distance = Math.min(2 * farthest, Math.max(0.3, sight.distance * factor));
}
