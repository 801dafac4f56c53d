"use strict";
// Unpacking of the block of bytes, surfaces and their normals, the camera, and drawing with WebGL2.
// Vectors are arrays of three numbers, in metres about the origin of the page.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const sum = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const length = Math.hypot(...a) || 1; return a.map((x) => x / length); };
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const NO_VALUE = 255;

async function inflate(text) {
  const packed = atob(text.trim()), bytes = new Uint8Array(packed.length);
  for (let i = 0; i < packed.length; i++) bytes[i] = packed.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// a table of unsigned integers from its byte planes; arrays of their width wrap as the packing did
function unpack(bytes, [offset, rows, columns, width, order]) {
  const count = rows * columns, out = new { 1: Uint8Array, 2: Uint16Array, 4: Uint32Array }[width](count);
  for (let b = 0; b < width; b++) {
    const plane = offset + b * count;
    for (let i = 0; i < count; i++) out[i] |= bytes[plane + i] << (8 * b);
  }
  for (let i = 0; i < count; i++) out[i] = (out[i] >>> 1) ^ -(out[i] & 1);
  for (let first = order; first > 0; first--)
    for (let i = first * columns; i < count; i++) out[i] += out[i - columns];
  return out;
}

// A drawn surface in one world. Points are those of the skin; vertices are points, doubled on sharp edges.
class Surface {
  constructor(bytes, mesh, world, data) {
    const packed = mesh.worlds[world];
    Object.assign(this, { mesh, world, name: mesh.name, kind: mesh.kind, packed });
    this.moves = unpack(bytes, packed.moves);
    this.frames = packed.moves[1];
    const rest = unpack(bytes, packed.rest);
    this.count = rest.length / 3;
    this.rest = new Float32Array(rest.length);
    for (let c = 0; c < 3; c++)
      for (let i = 0; i < this.count; i++)
        this.rest[3 * i + c] = packed.low[c] + packed.step * rest[c * this.count + i] + data.offsets[world][c];
    this.points = new Float32Array(this.rest);
    this.values = packed.values.map((place) => unpack(bytes, place));
    // topology is shared by the worlds
    mesh.sourceOf ??= mesh.source ? unpack(bytes, mesh.source) : new Uint32Array(0);
    for (const name of ["triangles", "edges", "nodes"])
      if (Array.isArray(mesh[name])) mesh[name] = unpack(bytes, mesh[name]);
    this.vertices = new Float32Array(8 * mesh.sourceOf.length); // position, normal, value x valid, valid
  }

  // points at a time between frames k and k + 1, displacements multiplied by `scale`
  move(k, part, scale) {
    const { count, rest, points, moves, packed } = this, last = this.frames - 1;
    const a = Math.min(k, last) * 3 * count, b = Math.min(k + 1, last) * 3 * count;
    for (let c = 0; c < 3; c++) {
      const least = packed.least[c] * scale, step = packed.quantum * scale;
      for (let i = 0, j = c * count; i < count; i++, j++)
        points[3 * i + c] = rest[3 * i + c] + least + step * ((1 - part) * moves[a + j] + part * moves[b + j]);
    }
  }

  // vertices of points, with the normals of the triangles around them
  shape(points, out) {
    const source = this.mesh.sourceOf, triangles = this.mesh.triangles;
    for (let v = 0; v < source.length; v++) {
      const p = 3 * source[v], o = 8 * v;
      for (let c = 0; c < 3; c++) { out[o + c] = points[p + c]; out[o + 3 + c] = 0; }
    }
    for (let t = 0; t < triangles.length; t += 3) {
      const a = 8 * triangles[t], b = 8 * triangles[t + 1], c = 8 * triangles[t + 2];
      const ux = out[b] - out[a], uy = out[b + 1] - out[a + 1], uz = out[b + 2] - out[a + 2];
      const vx = out[c] - out[a], vy = out[c + 1] - out[a + 1], vz = out[c + 2] - out[a + 2];
      const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
      for (const o of [a, b, c]) { out[o + 3] += x; out[o + 4] += y; out[o + 5] += z; }
    }
    for (let o = 0; o < out.length; o += 8) {
      const s = 1 / (Math.hypot(out[o + 3], out[o + 4], out[o + 5]) || 1);
      out[o + 3] *= s; out[o + 4] *= s; out[o + 5] *= s;
    }
  }

  // value of a field at a point; NaN where it has none
  value(field, k, part, point) {
    const codes = this.values[field.index], last = this.frames - 1;
    if (!codes) return NaN;
    const a = codes[Math.min(k, last) * this.count + point], b = codes[Math.min(k + 1, last) * this.count + point];
    if (a === NO_VALUE || (part > 0 && b === NO_VALUE)) return NaN;
    return field.low + field.step * ((1 - part) * a + part * b);
  }

  color(field, k, part) {
    const source = this.mesh.sourceOf, out = this.vertices;
    for (let v = 0; v < source.length; v++) {
      const value = field ? this.value(field, k, part, source[v]) : NaN;
      out[8 * v + 6] = Number.isNaN(value) ? 0 : value;
      out[8 * v + 7] = Number.isNaN(value) ? 0 : 1;
    }
  }
}

// Perspective camera by azimuth and elevation (degrees) about a target; `center`: place of the target in the picture.
class Camera {
  constructor(upAxis) {
    this.upAxis = upAxis;
    this.up0 = upAxis === "Y" ? [0, 1, 0] : [0, 0, 1];
    Object.assign(this, { target: [0, 0, 0], azimuth: -65, elevation: 20, distance: 1, fov: 24, center: [0, 0], size: 1 });
  }

  // direction to the eye, right and up of the picture
  axes() {
    const a = this.azimuth * Math.PI / 180, e = this.elevation * Math.PI / 180;
    const turned = (x, y, z) => this.upAxis === "Y" ? [x, z, -y] : [x, y, z];
    const back = turned(Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e));
    const right = turned(-Math.sin(a), Math.cos(a), 0);
    return { back, right, up: cross(back, right) };
  }

  eye() { return sum(this.target, this.axes().back, this.distance); }

  tangents(aspect) { const t = Math.tan(this.fov * Math.PI / 360); return [t * aspect, t]; }

  // place (x, y) in the picture, from -1 to 1, and depth of a point
  project(point, aspect) {
    const { back, right, up } = this.axes(), t = this.tangents(aspect), local = sum(point, this.eye(), -1);
    const depth = -dot(local, back);
    return [dot(local, right) / (t[0] * depth) + this.center[0], dot(local, up) / (t[1] * depth) + this.center[1], depth];
  }

  ray(x, y, aspect) {
    const { back, right, up } = this.axes(), t = this.tangents(aspect);
    let ray = sum([0, 0, 0], back, -1);
    ray = sum(ray, right, (x - this.center[0]) * t[0]);
    return unit(sum(ray, up, (y - this.center[1]) * t[1]));
  }

  // shows all points (a list of vectors) within shares of the width and the height around the center
  fit(points, aspect, shares) {
    const low = [0, 1, 2].map((c) => points.reduce((m, p) => Math.min(m, p[c]), Infinity));
    const high = [0, 1, 2].map((c) => points.reduce((m, p) => Math.max(m, p[c]), -Infinity));
    const middle = low.map((x, c) => 0.5 * (x + high[c]));
    this.size = Math.max(0.5 * Math.hypot(...sum(high, low, -1)), 1e-9);
    const { back, right, up } = this.axes(), t = this.tangents(aspect).map((x, k) => x * shares[k]);
    let distance = 1.02 * this.size;
    this.target = middle;
    for (const [axis, slope] of [[right, t[0]], [up, t[1]]]) {
      // the eye moves sideways so that both outermost points lie equally far from the middle
      let most = -Infinity, least = Infinity;
      for (const p of points) {
        const local = sum(p, middle, -1), side = dot(local, axis), depth = -dot(local, back);
        most = Math.max(most, side - slope * depth);
        least = Math.min(least, side + slope * depth);
      }
      distance = Math.max(distance, 0.5 * (most - least) / slope);
      this.target = sum(this.target, axis, 0.5 * (most + least));
    }
    this.distance = distance;
  }

  look() { return [this.azimuth, this.elevation, this.distance, ...this.target].join(); }
}

// points of the bodies among surfaces over the whole motion, and of colliders near them; the box of the bodies
function outline(surfaces, scale) {
  const bodies = surfaces.filter((s) => s.kind === "body"), points = [];
  const total = bodies.reduce((n, s) => n + s.count * s.frames, 0), stride = Math.max(1, Math.floor(total / 8000));
  for (const s of bodies)
    for (let k = 0; k < s.frames; k++) {
      s.move(k, 0, scale);
      for (let i = k % stride; i < s.count; i += stride) points.push(Array.from(s.points.subarray(3 * i, 3 * i + 3)));
    }
  const low = [0, 1, 2].map((c) => points.reduce((m, p) => Math.min(m, p[c]), Infinity));
  const high = [0, 1, 2].map((c) => points.reduce((m, p) => Math.max(m, p[c]), -Infinity));
  const wide = 0.15 * Math.hypot(...sum(high, low, -1));
  for (const s of surfaces.filter((other) => other.kind === "collider"))
    for (const k of [0, s.frames - 1]) {
      s.move(k, 0, 1);
      for (let i = 0; i < s.count; i += 4)
        points.push([0, 1, 2].map((c) => clamp(s.points[3 * i + c], low[c] - wide, high[c] + wide)));
    }
  return { points, box: [low, high] };
}

const SURFACE_VERTEX = `#version 300 es
layout(location = 0) in vec3 a_point;
layout(location = 1) in vec3 a_normal;
layout(location = 2) in vec2 a_value;
uniform vec3 u_eye, u_back, u_right, u_up;
uniform vec2 u_tangents, u_center, u_reach; // u_reach: nearest and farthest depth drawn
out vec3 v_point, v_normal;
out vec2 v_value;
void main() {
  vec3 local = a_point - u_eye;
  float depth = -dot(local, u_back);
  vec2 place = vec2(dot(local, u_right), dot(local, u_up)) / u_tangents + u_center * depth;
  float span = u_reach.y - u_reach.x;
  gl_Position = vec4(place, (depth * (u_reach.y + u_reach.x) - 2.0 * u_reach.y * u_reach.x) / span, depth);
  v_point = a_point; v_normal = a_normal; v_value = a_value;
}`;
// the light of kernels/outputs/raycast.py, without shadows
const SURFACE_FRAGMENT = `#version 300 es
precision highp float;
in vec3 v_point, v_normal;
in vec2 v_value;
uniform vec3 u_eye, u_sky, u_light, u_plain;
uniform vec2 u_range;
uniform vec4 u_cut, u_line; // u_cut: direction and place; u_line: color of lines, alpha 0: a surface
uniform float u_alpha, u_grid, u_fade;
uniform sampler2D u_map;
out vec4 color;
vec3 linear(vec3 c) { return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c)); }
vec3 display(vec3 c) { return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c)); }
float lines(vec2 place, float step, float wide) {
  vec2 x = place / step, d = abs(x - round(x)) / max(fwidth(x), vec2(1e-6));
  return 1.0 - smoothstep(wide, wide + 1.0, min(d.x, d.y));
}
void main() {
  if (dot(v_point, u_cut.xyz) > u_cut.w) discard;
  if (u_line.a > 0.0) { color = vec4(u_line.rgb * u_line.a, u_line.a); return; }
  vec3 ray = normalize(v_point - u_eye), flat_normal = normalize(cross(dFdx(v_point), dFdy(v_point)));
  if (dot(flat_normal, ray) > 0.0) flat_normal = -flat_normal;
  vec3 n = normalize(v_normal);
  if (dot(n, flat_normal) < 0.0) n = -n;
  vec3 albedo = u_plain;
  if (u_range.y >= u_range.x) {
    float value = v_value.y > 0.0 ? v_value.x / v_value.y : 0.0;
    float t = u_range.y > u_range.x ? clamp((value - u_range.x) / (u_range.y - u_range.x), 0.0, 1.0) : 0.0;
    albedo = mix(vec3(0.5), texture(u_map, vec2((t * 255.0 + 0.5) / 256.0, 0.5)).rgb, v_value.y);
  }
  albedo = linear(albedo);
  float alpha = u_alpha;
  if (u_grid > 0.0) {
    vec2 place = u_sky.z > 0.5 ? v_point.xy : v_point.xz;
    float fine = 0.45 * lines(place, u_grid, 0.2), strong = 0.7 * lines(place, 5.0 * u_grid, 0.5);
    albedo = mix(albedo, min(vec3(0.5, 0.53, 0.58), 3.0 * albedo), max(fine, strong));
    float r = length(v_point) / u_fade;
    alpha *= exp(-r * r * r);
  }
  float key = max(dot(n, u_light), 0.0), head = max(-dot(n, ray), 0.0), sky = 0.5 + 0.5 * dot(n, u_sky);
  float shine = 0.07 * pow(max(dot(n, normalize(u_light - ray)), 0.0), 40.0) * min(key * 4.0, 1.0);
  vec3 light = albedo * (0.24 + 0.18 * sky + 0.46 * key + 0.26 * head) + shine;
  color = vec4(display(clamp(light, 0.0, 1.0)) * alpha, alpha);
}`;

// Draws surfaces; `context` is WebGL2 with premultiplied alpha over the page's background.
class Painter {
  constructor(context) {
    this.gl = context;
    const gl = context, program = this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, SURFACE_VERTEX], [gl.FRAGMENT_SHADER, SURFACE_FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.at = {};
    for (let k = 0; k < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); k++) {
      const { name } = gl.getActiveUniform(program, k);
      this.at[name] = gl.getUniformLocation(program, name);
    }
    this.meshes = new Map();
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  }

  setMap(colors) { // 256 x 3 bytes
    const gl = this.gl;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, colors);
  }

  // buffers: of indices one for all worlds, of vertices one for each surface
  indices(mesh) {
    if (!this.meshes.has(mesh)) {
      const gl = this.gl, vertexOf = new Uint32Array(mesh.sourceOf.length);
      for (let v = mesh.sourceOf.length - 1; v >= 0; v--) vertexOf[mesh.sourceOf[v]] = v;
      const make = (values) => {
        const buffer = gl.createBuffer();
        gl.bindVertexArray(null);
        gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, values, gl.STATIC_DRAW);
        return { buffer, count: values.length };
      };
      this.meshes.set(mesh, { triangles: make(mesh.triangles), edges: make(mesh.edges.map((p) => vertexOf[p])) });
    }
    return this.meshes.get(mesh);
  }

  upload(surface, key, vertices) {
    const gl = this.gl;
    let held = (surface.buffers ??= {})[key];
    if (!held) {
      held = surface.buffers[key] = { array: gl.createVertexArray(), buffer: gl.createBuffer() };
      gl.bindVertexArray(held.array);
      gl.bindBuffer(gl.ARRAY_BUFFER, held.buffer);
      for (const [place, size, offset] of [[0, 3, 0], [1, 3, 12], [2, 2, 24]]) {
        gl.enableVertexAttribArray(place);
        gl.vertexAttribPointer(place, size, gl.FLOAT, false, 32, offset);
      }
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, held.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, vertices, gl.DYNAMIC_DRAW);
  }

  begin(camera, width, height, cut) {
    const gl = this.gl, at = this.at, { back, right, up } = camera.axes(), eye = camera.eye();
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const set = (name, values) => gl[`uniform${values.length}fv`](at[name], values);
    set("u_eye", eye); set("u_back", back); set("u_right", right); set("u_up", up); set("u_sky", camera.up0);
    set("u_tangents", camera.tangents(width / height)); set("u_center", camera.center); set("u_cut", cut);
    const far = camera.distance + 14 * camera.size;
    set("u_reach", [Math.max(camera.distance - 3 * camera.size, 2e-3 * camera.distance), far]);
    let light = sum(sum([0, 0, 0], up, 0.55), right, -0.55);
    light = unit(sum(sum(light, back, 0.45), camera.up0, 0.75));
    set("u_light", light);
    gl.uniform1f(at.u_fade, 2.2 * camera.size);
  }

  // how: {plain: color, range, alpha, grid, line, part: "triangles" | "edges"}
  draw(surface, key, how) {
    const gl = this.gl, at = this.at, part = how.part ?? "triangles", index = this.indices(surface.mesh)[part];
    gl.bindVertexArray(surface.buffers[key].array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, index.buffer);
    gl.uniform3fv(at.u_plain, how.plain ?? [0.62, 0.66, 0.72]);
    gl.uniform2fv(at.u_range, how.range ?? [1, 0]);
    gl.uniform4fv(at.u_line, how.line ?? [0, 0, 0, 0]);
    gl.uniform1f(at.u_alpha, how.alpha ?? 1);
    gl.uniform1f(at.u_grid, how.grid ?? 0);
    const thin = (how.alpha ?? 1) < 1 || how.grid || how.line;
    gl[thin ? "enable" : "disable"](gl.BLEND);
    gl.depthMask(!thin);
    if (part === "triangles") { gl.enable(gl.POLYGON_OFFSET_FILL); gl.polygonOffset(1, 1); }
    gl.drawElements(part === "edges" ? gl.LINES : gl.TRIANGLES, index.count, gl.UNSIGNED_INT, 0);
    gl.depthMask(true);
  }
}
