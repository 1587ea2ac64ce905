// The 3D view: points with eye-dome lighting, surfaces, sensors, actors, the path, and the camera.
import * as THREE from "./three.min.js";
import { element, saveFile } from "./controls.js";

THREE.ColorManagement.enabled = false; // so that colors match the legends

const THEMES = {
  light: { back: 0xffffff, grid: 0xdfe3e8, surface: 0xd3d7dc, rays: 0xe88c96 },
  dark: { back: 0x14171c, grid: 0x363e48, surface: 0x3c434d, rays: 0x8f3c48 },
};
const RED = 0xe0182d, GREEN = 0x149650, DISC = 0x78828f, MARK = 0xff00a0, CLIP = 0x2f8fe0;
const FOV = 45; // vertical field of view in degrees
const SIDES = { all: [0.55, -1, 0.62], inside: [0.12, -0.25, 1], top: [0, 0, 1], side: [1, 0, 0], front: [0, -1, 0] };
const FLIGHT_M = 10; // minimum height of a flying platform
const PICKED_WITHIN = 6; // pixels
const SAME_SURFACE = 1.03; // as a multiple of the distance of the nearest point
const AS_POINTS = 0.25; // alpha of pixels with points, which get eye-dome lighting

const POINT_VERTEX = `
  uniform float size, pixels, least, most;
  uniform vec3 low, high;
  uniform bool flat_;
  attribute vec4 color;
  varying vec3 shade;
  void main() {
    shade = color.rgb;
    vec4 at = modelViewMatrix * vec4(position, 1.0);
    gl_Position = projectionMatrix * at;
    gl_PointSize = clamp(size * pixels / (flat_ ? 1.0 : max(-at.z, 1e-6)), least, most);
    if (any(lessThan(position, low)) || any(greaterThan(position, high)))
      gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  }`;
const POINT_FRAGMENT = `
  varying vec3 shade;
  void main() {
    vec2 away = gl_PointCoord - 0.5;
    if (dot(away, away) > 0.25) discard;
    gl_FragColor = vec4(shade, ${AS_POINTS});
  }`;

// Eye-dome lighting: Boucheny, "Visualization scientifique de grands volumes de données" (2009).
// A pixel is darker the more its neighbors are in front of it. Surfaces are rendered separately and
// blended: almost transparent in front of points, so that walls do not hide the points.
const SHADE_VERTEX = `
  varying vec2 at;
  void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }`;
const SHADE_FRAGMENT = `
  uniform sampler2D picture, depths, surface, surfaceDepths;
  uniform vec2 pixel;
  uniform float near, far, strength, opacity;
  uniform bool flat_;
  varying vec2 at;
  const float NOTHING = -1e9;
  float scaled(float d) { return flat_ ? d * (far - near) : log2(near * far / (far - d * (far - near))); }
  float depth(vec2 where_) {
    float d = texture2D(depths, where_).x;
    return d >= 1.0 ? NOTHING : scaled(d);
  }
  void main() {
    vec4 found = texture2D(picture, at), wall = texture2D(surface, at);
    float own = depth(at), sum = 0.0;
    if (strength > 0.0 && found.a > 0.1 && found.a < 0.6 && own > NOTHING) {
      for (int k = 0; k < 8; k++) {
        float angle = float(k) * 0.7853982;
        float other = depth(at + 1.4 * pixel * vec2(cos(angle), sin(angle)));
        if (other > NOTHING) sum += min(strength * max(0.0, own - other), 1.2);
      }
    }
    vec3 shown = found.rgb * exp(-sum / 8.0);
    float before = own - scaled(texture2D(surfaceDepths, at).x);
    if (own == NOTHING) shown = mix(shown, wall.rgb, wall.a * mix(opacity, 1.0, 0.4));
    else if (before > (flat_ ? 0.1 : 0.03)) shown = mix(shown, wall.rgb, wall.a * opacity);
    gl_FragColor = vec4(shown, 1.0);
  }`;

const lerp = (a, b, share) => a + (b - a) * share;

// Returns the index of the last of ascending numbers that is at most a value, or -1.
export function lastNotAbove(numbers, value) {
  let low = 0, high = numbers.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (numbers[middle] <= value) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

// Returns the ends of the twelve edges of a box.
function edgesOf({ min, max }) {
  const corner = (k) => [k & 1 ? max.x : min.x, k & 2 ? max.y : min.y, k & 4 ? max.z : min.z];
  return [1, 2, 4].flatMap((side) => [0, 1, 2, 3, 4, 5, 6, 7].filter((k) => !(k & side)).flatMap((k) => [...corner(k), ...corner(k + side)]));
}

// Interpolates positions (k, 3) at ascending times.
function placeAt(times, places, time, moves, width = 3) {
  const before = Math.max(0, lastNotAbove(times, time));
  const after = Math.min(before + 1, times.length - 1);
  const span = times[after] - times[before];
  const share = moves && span > 0 ? Math.min(1, Math.max(0, (time - times[before]) / span)) : 0;
  return Array.from({ length: width }, (_, axis) => lerp(places[width * before + axis], places[width * after + axis], share));
}

// Deforms the mesh of an actor to a fractional frame: 1.5 is halfway between its second and third pose.
function bend({ mesh, poses, faces }, frame) {
  const [count, vertices] = poses.shape, at = frame - (count - 1) * Math.floor(frame / (count - 1));
  const corners = mesh.geometry.attributes.position;
  const here = (k) => 3 * (vertices * Math.floor(at) + faces[Math.floor(k / 3)]) + (k % 3);
  corners.array.forEach((_, k, all) => { all[k] = lerp(poses[here(k)], poses[here(k) + 3 * vertices], at % 1); });
  corners.needsUpdate = true;
}

// Returns the distinct station names of a stationary sensor: [text, place, class].
function stationsOf({ name, labels, places, at }) {
  const distinct = new Map(labels.map((label, k) => [label, places.subarray(3 * k, 3 * k + 3)]));
  if (distinct.size < 2) return [[name || "sensor", at]];
  return [...distinct].map(([label, place]) => [label, place, at.every((value, axis) => value === place[axis]) ? "current station" : "station"]);
}

export class Picture {
  constructor(canvas, labels, handlesBox, axes, scale, changed) {
    Object.assign(this, { canvas, labels, handlesBox, axes, scale, changed });
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.renderer.localClippingEnabled = true;
    this.scene = new THREE.Scene();
    this.solid = new THREE.Scene(); // the surfaces, and the grid below them
    for (const lit of [this.scene, this.solid]) {
      const sun = new THREE.DirectionalLight(0xffffff, 1.4);
      sun.position.set(0.15, -0.75, 1.2);
      lit.add(new THREE.HemisphereLight(0xffffff, 0xb9bdc4, 2.1), sun);
    }
    this.perspective = new THREE.PerspectiveCamera(FOV, 1, 0.1, 1000);
    this.parallel = new THREE.OrthographicCamera(-1, 1, 1, -1, 0, 1000);
    for (const camera of [this.perspective, this.parallel]) camera.up.set(0, 0, 1);
    this.camera = this.perspective;
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enableDamping: true, dampingFactor: 0.18, zoomToCursor: true, screenSpacePanning: true });
    this.controls.addEventListener("change", () => { this.dirty = true; changed(); });
    this.controls.addEventListener("start", () => { this.touched = true; }); // by the user
    this.pointMaterial = new THREE.ShaderMaterial({
      vertexShader: POINT_VERTEX, fragmentShader: POINT_FRAGMENT,
      uniforms: {
        size: { value: 0.1 }, pixels: { value: 1 }, least: { value: 1 }, most: { value: 8 }, flat_: { value: false },
        low: { value: new THREE.Vector3() }, high: { value: new THREE.Vector3() },
      },
    });
    this.planes = [0, 1, 2].flatMap((axis) => [1, -1].map((sign) =>
      new THREE.Plane(new THREE.Vector3().setComponent(axis, sign), 1e9)));
    this.surfaceMaterial = new THREE.MeshLambertMaterial({ flatShading: true, side: THREE.DoubleSide, clippingPlanes: this.planes });
    this.makePasses();
    this.layers = {}; // {name: Points}
    this.names = []; // [text, place, element]
    this.onlyObjects = null;
    this.hiddenObjects = new Set();
    this.sensors = [];
    this.actors = [];
    this.marks = [];
    this.extent = 1;
    this.pointScale = 1;
    this.strength = 1;
    this.opacity = 0.2;
    this.boxes = true;
    this.dirty = true;
    this.theme = "light";
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("webglcontextrestored", () => { this.dirty = true; });
  }

  makePasses() {
    [this.target, this.solidTarget] = [0, 1].map(() =>
      new THREE.WebGLRenderTarget(4, 4, { samples: 4, depthTexture: new THREE.DepthTexture(4, 4, THREE.FloatType) }));
    this.shading = new THREE.ShaderMaterial({
      vertexShader: SHADE_VERTEX, fragmentShader: SHADE_FRAGMENT, depthTest: false, depthWrite: false,
      uniforms: {
        picture: { value: this.target.texture }, depths: { value: this.target.depthTexture }, pixel: { value: new THREE.Vector2() },
        surface: { value: this.solidTarget.texture }, surfaceDepths: { value: this.solidTarget.depthTexture },
        near: { value: 1 }, far: { value: 2 }, strength: { value: 0 }, opacity: { value: 1 }, flat_: { value: false },
      },
    });
    this.screen = new THREE.Scene();
    this.screen.add(new THREE.Mesh(new THREE.PlaneGeometry(2, 2), this.shading));
    this.screenCamera = new THREE.OrthographicCamera(-1, 1, 1, -1, 0, 1);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    const ratio = Math.min(window.devicePixelRatio, 2);
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    for (const target of [this.target, this.solidTarget]) target.setSize(Math.round(width * ratio), Math.round(height * ratio));
    this.perspective.aspect = width / height;
    this.perspective.updateProjectionMatrix();
    const half = this.parallel.top;
    this.parallel.left = (-half * width) / height;
    this.parallel.right = (half * width) / height;
    this.parallel.updateProjectionMatrix();
    this.dirty = true;
    this.changed();
  }

  // -- content -----------------------------------------------------------------------------

  // box: [low, high] to show; corners: corners of the scene, and sensors; bounds: bounds of everything
  frame(box, corners, bounds) {
    this.corners = [];
    for (let k = 0; k < corners.length; k += 3) this.corners.push(new THREE.Vector3(...corners.subarray(k, k + 3)));
    this.box = box.map((corner) => new THREE.Vector3(...corner));
    this.bounds = bounds.map((corner) => new THREE.Vector3(...corner));
    this.extent = this.box[0].distanceTo(this.box[1]) || 1;
    const ends = ["x", "y", "z"].map((axis) => this.corners.map((corner) => corner[axis]).reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]));
    this.middle = new THREE.Vector3(...ends.map(([low, high]) => (low + high) / 2)); // center of the first view
    this.reach = this.bounds[0].distanceTo(this.bounds[1]) || 1;
    this.setClip([[null, null], [null, null], [null, null]]);
    this.addGrid();
    this.look("all");
  }

  addGrid() {
    if (this.grid) this.solid.remove(this.grid);
    const [low, high] = this.box;
    const step = 10 ** Math.floor(Math.log10(this.extent / 4));
    const lines = [];
    const ends = ["x", "y"].map((axis) => {
      const room = 0.2 * (high[axis] - low[axis]) + 2 * step;
      return [Math.floor((low[axis] - room) / step), Math.ceil((high[axis] + room) / step)];
    });
    const z = low.z - 0.002 * this.extent;
    const [[x0, x1], [y0, y1]] = ends.map((pair) => pair.map((n) => n * step));
    for (let x = ends[0][0]; x <= ends[0][1]; x++) lines.push(x * step, y0, z, x * step, y1, z);
    for (let y = ends[1][0]; y <= ends[1][1]; y++) lines.push(x0, y * step, z, x1, y * step, z);
    this.gridStep = step;
    this.grid = this.thinLines(lines, THEMES[this.theme].grid);
    this.solid.add(this.grid);
  }

  thinLines(numbers, color) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(numbers, 3));
    const made = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color, clippingPlanes: [] }));
    made.frustumCulled = false;
    return made;
  }

  thickLines(numbers, color, linewidth) {
    const geometry = new THREE.LineSegmentsGeometry().setPositions(numbers);
    const made = new THREE.LineSegments2(geometry, new THREE.LineMaterial({ color, linewidth }));
    made.frustumCulled = false;
    return made;
  }

  setTheme(theme) {
    this.theme = theme;
    const { back, grid, surface, rays } = THEMES[theme];
    this.scene.background = new THREE.Color(back);
    if (this.grid) this.grid.material.color.set(grid);
    if (this.rays) this.rays.material.color.set(rays);
    if (!this.surfaceMaterial.vertexColors) this.surfaceMaterial.color.set(surface);
    for (const actor of this.actors) if (!actor.colored) actor.mesh.material.color.set(surface);
    this.dirty = true;
  }

  setPoints(layer, told) {
    const old = this.layers[layer];
    if (old) {
      this.scene.remove(old);
      old.geometry.dispose();
      delete this.layers[layer];
    }
    this.dirty = true;
    if (!told || !told.arrays.rows.length) return;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(told.arrays.positions, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(told.arrays.colors, 4, true));
    const points = new THREE.Points(geometry, this.pointMaterial);
    points.frustumCulled = false;
    points.told = told;
    this.scene.add(points);
    this.layers[layer] = points;
    this.sizePoints();
  }

  get drawn() {
    return Object.values(this.layers).reduce((sum, points) => sum + points.told.arrays.rows.length, 0);
  }

  // Points are visible where there are few, and distinguishable where there are many.
  sizePoints() {
    const count = Math.max(1, this.drawn);
    const { size, least, most } = this.pointMaterial.uniforms;
    const ratio = this.renderer.getPixelRatio();
    size.value = this.pointScale * this.extent * Math.min(0.0035, 1.2 / Math.sqrt(count));
    least.value = ratio * (count < 20_000 ? 3.5 : count < 3_000_000 ? 2.2 : 1.5) * Math.sqrt(this.pointScale);
    most.value = ratio * Math.max(2, 7 * this.pointScale);
    this.dirty = true;
  }

  setSurface(told) {
    if (this.surface) {
      this.solid.remove(this.surface);
      this.surface.geometry.dispose();
      this.surface = null;
    }
    this.dirty = true;
    if (!told || !told.arrays.corners.length) return;
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(told.arrays.corners, 3));
    const colored = "colors" in told.arrays;
    if (colored) geometry.setAttribute("color", new THREE.BufferAttribute(told.arrays.colors, 3, true));
    this.surfaceMaterial.vertexColors = colored;
    this.surfaceMaterial.color.set(colored ? 0xffffff : THEMES[this.theme].surface);
    this.surfaceMaterial.needsUpdate = true;
    this.surface = new THREE.Mesh(geometry, this.surfaceMaterial);
    this.surface.frustumCulled = false;
    this.surface.objects = told.arrays.objects;
    this.solid.add(this.surface);
    this.showObjects(this.onlyObjects, this.hiddenObjects);
  }

  // limits: [lowest, highest] displayed object, or null; hidden: objects that are switched off
  showObjects(limits, hidden) {
    Object.assign(this, { onlyObjects: limits, hiddenObjects: hidden });
    const shown = (object) => object === null || ((!limits || (object >= limits[0] && object <= limits[1])) && !hidden.has(object));
    if (this.surface) {
      const { objects, geometry } = this.surface;
      if (!limits && !hidden.size) geometry.setIndex(null);
      else {
        const index = [];
        objects.forEach((object, k) => { if (shown(object)) index.push(3 * k, 3 * k + 1, 3 * k + 2); });
        geometry.setIndex(index);
      }
    }
    for (const actor of this.actors) actor.shown = shown(actor.object) && !this.actorsHidden;
    if (this.time !== undefined) this.setTime(this.time);
    if (this.rays) this.rays.visible = !limits && this.raysShown !== false;
    this.dirty = true;
  }

  setActors(actors) {
    for (const actor of this.actors) this.scene.remove(actor.mesh);
    this.actors = actors;
    const made = new Map(); // {corners: geometry that actors share}
    for (const actor of actors) {
      if (actor.poses) actor.corners = actor.corners.slice(); // each actor has its own pose
      const geometry = made.get(actor.corners) ?? new THREE.BufferGeometry();
      made.set(actor.corners, geometry);
      actor.shown = !this.actorsHidden;
      geometry.setAttribute("position", new THREE.BufferAttribute(actor.corners, 3));
      if (actor.own) geometry.setAttribute("color", new THREE.BufferAttribute(actor.own, 3, true));
      const material = new THREE.MeshLambertMaterial({ flatShading: true, side: THREE.DoubleSide, clippingPlanes: this.planes });
      actor.mesh = new THREE.Mesh(geometry, material);
      actor.mesh.frustumCulled = false;
      geometry.computeBoundingBox();
      if (actor.poses) geometry.boundingBox.setFromArray(actor.poses);
      actor.top = geometry.boundingBox.max.z;
      actor.box = this.thickLines(edgesOf(geometry.boundingBox), new THREE.Color(...actor.color.map((byte) => byte / 255)), 2);
      actor.box.visible = this.boxes;
      actor.mesh.add(actor.box);
      this.scene.add(actor.mesh);
    }
  }

  showBoxes(on) {
    this.boxes = on;
    for (const actor of this.actors) actor.box.visible = on;
    this.dirty = true;
  }

  // by: "object" for one color per actor, "color" for the colors in their files
  colorActors(by) {
    for (const actor of this.actors) {
      const { material } = actor.mesh, own = by === "color" && actor.own;
      actor.colored = by === "object" || own;
      material.vertexColors = Boolean(own);
      if (own) material.color.set(0xffffff);
      else if (by === "object") material.color.setRGB(...actor.color.map((byte) => byte / 255));
      else material.color.set(THEMES[this.theme].surface);
      material.needsUpdate = true;
    }
    this.dirty = true;
  }

  setSensors(sensors) {
    for (const made of this.sensorParts ?? []) this.scene.remove(made);
    this.sensorParts = [];
    this.balls = []; // [mesh, radius in meters]
    this.sensors = sensors;
    const ball = new THREE.SphereGeometry(1, 20, 12), red = new THREE.MeshBasicMaterial({ color: RED });
    for (const sensor of sensors) {
      sensor.marker = new THREE.Mesh(ball, red);
      this.balls.push([sensor.marker, (sensor.moves ? 0.0036 : 0.009) * this.extent]);
      this.sensorParts.push(sensor.marker);
      const { places } = sensor, count = places.length / 3;
      sensor.way = new THREE.Group();
      if (sensor.moves) this.drawWay(sensor);
      else {
        for (let k = 0; k < count && k < 1000; k++) {
          const mark = new THREE.Mesh(ball, red);
          mark.position.set(...places.subarray(3 * k, 3 * k + 3));
          this.balls.push([mark, 0.0054 * this.extent]);
          sensor.way.add(mark);
        }
      }
      this.sensorParts.push(sensor.way);
    }
    for (const made of this.sensorParts) this.scene.add(made);
  }

  // Draws the trajectory of a moving sensor, replacing the previous one.
  drawWay({ way, places }) {
    for (const { geometry, material } of way.children) {
      geometry.dispose();
      material.dispose();
    }
    way.clear();
    const lines = [];
    for (let k = 0; 3 * k + 3 < places.length; k++) lines.push(...places.subarray(3 * k, 3 * k + 6));
    if (lines.length) way.add(this.thickLines(lines, RED, 3));
  }

  setRays(ends) {
    if (this.rays) this.scene.remove(this.rays);
    this.rays = null;
    this.dirty = true;
    if (!ends || !ends.length) return;
    this.rays = this.thinLines(ends, THEMES[this.theme].rays);
    this.rays.material.clippingPlanes = this.planes;
    this.scene.add(this.rays);
    this.showObjects(this.onlyObjects, this.hiddenObjects);
  }

  setPath(path, ground) {
    if (this.path) this.scene.remove(this.path);
    this.path = null;
    this.dirty = true;
    if (!path) return;
    const z = ground + 0.004 * this.extent, lines = [];
    this.path = new THREE.Group();
    path.corners.slice(1).forEach(([x, y], k) => lines.push(...path.corners[k], z, x, y, z));
    this.path.add(this.thickLines(lines, GREEN, 4));
    for (const [x, y, radius] of path.discs) {
      const disc = new THREE.Mesh(
        new THREE.CircleGeometry(radius, 48), new THREE.MeshBasicMaterial({ color: DISC, transparent: true, opacity: 0.35, depthWrite: false }));
      disc.position.set(x, y, ground + 0.002 * this.extent);
      this.path.add(disc);
    }
    this.path.ends = [["start", path.corners[0]], ["target", path.corners.at(-1)]].map(([text, [x, y]]) => [text, [x, y, z]]);
    this.scene.add(this.path);
  }

  // Places sensors and actors as at a time in seconds.
  setTime(time) {
    const before = this.carrier;
    this.time = time;
    for (const sensor of this.sensors) {
      sensor.at = placeAt(sensor.times, sensor.places, time, sensor.moves);
      sensor.marker.position.set(...sensor.at);
      sensor.marker.visible = sensor.way.visible = sensor.shown;
    }
    for (const actor of this.actors) {
      actor.mesh.visible = actor.shown && actor.there[0] <= time && time <= actor.there[1];
      actor.at = placeAt(actor.times, actor.places, time, true);
      actor.mesh.position.set(...actor.at);
      const k = Math.max(0, lastNotAbove(actor.times, time));
      actor.mesh.quaternion.set(...actor.turns.subarray(4 * k, 4 * k + 4)).normalize();
      if (actor.poses && actor.mesh.visible) bend(actor, placeAt(actor.times, actor.frames, time, true, 1)[0]);
    }
    const moving = this.sensors.find((sensor) => sensor.moves) ?? this.sensors[0];
    this.carrier = moving ? new THREE.Vector3(...moving.at) : null;
    const heading = this.heading;
    this.heading = this.headingOf(moving);
    if (this.follow && before && this.carrier) this.moveWith(before, heading ?? this.heading);
    this.dirty = true;
  }

  // Moves and rotates the camera with the vehicle, starting from a previous position and heading.
  moveWith(before, heading) {
    const turn = Math.atan2(this.heading.y, this.heading.x) - Math.atan2(heading.y, heading.x);
    for (const place of [this.camera.position, this.controls.target])
      place.sub(before).applyAxisAngle(this.camera.up, turn).add(this.carrier);
    this.controls.update();
  }

  // Returns the current horizontal direction of a moving sensor, or the x axis if it is stationary.
  headingOf(moving) {
    const ahead = new THREE.Vector3(1, 0, 0);
    if (!moving?.moves) return ahead;
    const step = 0.02 * (moving.times.at(-1) - moving.times[0]);
    const [a, b] = [-step, step].map((part) => new THREE.Vector3(...placeAt(moving.times, moving.places, this.time + part, true)));
    const way = b.sub(a).setZ(0);
    return way.length() > 1e-6 ? way.normalize() : this.heading ?? ahead;
  }

  get labeled() {
    const names = this.marks.filter((mark) => mark.text).map((mark) => [mark.text, mark.place]);
    const moving = this.sensors.filter((sensor) => sensor.moves && sensor.shown && sensor.at);
    if (moving.length) names.push([moving.map((sensor) => sensor.name).filter(Boolean).join(", ") || "sensor", moving[0].at]);
    for (const sensor of this.sensors) if (!sensor.moves && sensor.shown && sensor.at) names.push(...stationsOf(sensor));
    for (const actor of this.actors)
      if (this.boxes && actor.mesh.visible && actor.at) names.push([actor.label, [actor.at[0], actor.at[1], actor.at[2] + actor.top]]);
    return [...names, ...(this.path?.ends ?? [])].slice(0, 100);
  }

  // limits: [lowest, highest] of each axis, null for none
  setClip(limits) {
    this.clip = limits;
    const { low, high } = this.pointMaterial.uniforms;
    limits.forEach(([least, most], axis) => {
      low.value.setComponent(axis, least ?? -1e12);
      high.value.setComponent(axis, most ?? 1e12);
      this.planes[2 * axis].constant = -(least ?? -1e12);
      this.planes[2 * axis + 1].constant = most ?? 1e12;
    });
    this.dirty = true;
  }

  // -- camera ----------------------------------------------------------------------------

  // Places the camera so that all corners are within 0.9 of the view.
  look(side) {
    const away = new THREE.Vector3(...SIDES[side === "all" && this.roofed ? "inside" : side]).normalize();
    const up = new THREE.Vector3(0, side === "top" ? 1 : 0, side === "top" ? 0 : 1);
    const right = up.clone().cross(away).normalize(), tall = away.clone().cross(right);
    const slope = 0.9 * Math.tan((FOV * Math.PI) / 360);
    const ahead = this.corners.map((corner) => corner.dot(away)), depth = (Math.min(...ahead) + Math.max(...ahead)) / 2;
    const target = away.clone().multiplyScalar(depth);
    let distance = 0;
    for (const [axis, tangent] of [[right, slope * this.perspective.aspect], [tall, slope]]) {
      // The edges of the view touch the outermost corners, and closer corners appear larger.
      const ends = [1, -1].map((sign) => Math.max(...this.corners.map((corner, k) =>
        sign * corner.dot(axis) + (side === "all" ? tangent * (ahead[k] - depth) : 0))));
      target.addScaledVector(axis, (ends[0] - ends[1]) / 2);
      distance = Math.max(distance, (ends[0] + ends[1]) / 2 / tangent);
    }
    this.place(target.clone().addScaledVector(away, distance || 1), target);
    this.useParallel(side !== "all");
  }

  // Whether a moving platform is far above the displayed content.
  get isHigh() {
    return this.sensors.some((sensor) => sensor.moves) && this.carrier.z - this.middle.z > 0.1 * this.extent;
  }

  // A car is not a flying platform, however small its surroundings are.
  get isFlying() { return this.isHigh && this.carrier.z - this.middle.z > FLIGHT_M; }

  // Places the camera behind and above the platform, looking forward or, if it is stationary, to the center.
  lookFromSensor() {
    if (!this.carrier) return;
    const moving = this.sensors.find((sensor) => sensor.moves);
    const inwards = this.middle.clone().sub(this.carrier);
    const ahead = !moving && inwards.length() > 0.1 * this.extent ? inwards.normalize() : this.heading;
    const back = 0.14 * this.extent, target = this.carrier.clone().addScaledVector(ahead, 0.3 * this.extent);
    const eye = this.carrier.clone().addScaledVector(ahead, -back).add(new THREE.Vector3(0, 0, 0.6 * back));
    if (this.isHigh) target.z = this.middle.z; // the ground is far below
    else { // look down far enough to show the ground below the platform
      const down = Math.atan2(eye.z - this.box[0].z, back) - (0.92 * FOV * Math.PI) / 360;
      target.z = Math.min(target.z, eye.z - Math.tan(down) * (back + 0.3 * this.extent));
    }
    this.useParallel(false);
    this.place(eye, target);
  }

  // Moves the camera with the local origin.
  shift(way) {
    const by = new THREE.Vector3(...way);
    this.place(this.camera.position.clone().add(by), this.controls.target.clone().add(by));
  }

  place(position, target) {
    // Exactly from above, the controls cannot determine the up direction.
    const eye = position.clone();
    if (Math.hypot(eye.x - target.x, eye.y - target.y) < 1e-4 * eye.distanceTo(target)) eye.y -= 1e-4 * eye.distanceTo(target);
    for (const camera of [this.perspective, this.parallel]) camera.position.copy(eye);
    this.controls.target.copy(target);
    this.controls.update();
    this.dirty = true;
  }

  get isParallel() { return this.camera === this.parallel; }

  useParallel(parallel) {
    const half = this.viewHeight / 2;
    const from = this.camera, to = parallel ? this.parallel : this.perspective;
    if (from !== to) {
      to.position.copy(from.position);
      this.camera = this.controls.object = to;
    }
    const target = this.controls.target;
    if (parallel) {
      const height = from === to ? Math.tan((FOV * Math.PI) / 360) * to.position.distanceTo(target) : half;
      Object.assign(this.parallel, { top: height, bottom: -height, zoom: 1 });
      this.resize();
    } else if (from !== to) {
      const distance = half / Math.tan((FOV * Math.PI) / 360);
      to.position.sub(target).setLength(distance).add(target);
    }
    this.controls.update();
    this.dirty = true;
    this.changed();
  }

  // Returns the height of the view in meters at the camera's target.
  get viewHeight() {
    if (this.isParallel) return (this.parallel.top - this.parallel.bottom) / this.parallel.zoom;
    return 2 * Math.tan((FOV * Math.PI) / 360) * this.perspective.position.distanceTo(this.controls.target);
  }

  get matrix() {
    this.updateCamera();
    return new THREE.Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
  }

  updateCamera() {
    const distance = this.camera.position.distanceTo(this.controls.target), reach = 3 * this.reach + distance;
    if (this.isParallel) Object.assign(this.camera, { near: -reach, far: reach });
    else Object.assign(this.camera, { near: Math.min(Math.max(0.01 * distance, 0.02), this.reach / 50), far: reach });
    this.camera.updateProjectionMatrix();
    this.camera.updateMatrixWorld();
  }

  // -- drawing ---------------------------------------------------------------------------

  // Called for each frame. Draws if anything has changed.
  draw() {
    this.controls.update();
    if (!this.dirty) return;
    this.dirty = false;
    this.updateCamera();
    this.drawClipBox();
    const { uniforms } = this.pointMaterial;
    const height = this.target.height;
    uniforms.flat_.value = this.isParallel;
    uniforms.pixels.value = height / (this.isParallel ? this.viewHeight : 2 * Math.tan((FOV * Math.PI) / 360));
    for (const [ball, radius] of this.balls ?? []) ball.scale.setScalar(Math.min(radius, 0.012 * this.distanceTo(ball.position)));
    for (const mark of this.marks) if (mark.ball) mark.ball.scale.setScalar(0.006 * this.distanceTo(mark.place));
    const shade = this.shading.uniforms;
    shade.pixel.value.set(1 / this.target.width, 1 / height);
    shade.near.value = this.camera.near;
    shade.far.value = this.camera.far;
    shade.flat_.value = this.isParallel;
    shade.strength.value = this.strength * (this.isParallel ? 144 / this.viewHeight : 120);
    shade.opacity.value = this.opacity;
    this.renderer.setClearColor(0, 0);
    for (const [target, scene] of [[this.target, this.scene], [this.solidTarget, this.solid]]) {
      this.renderer.setRenderTarget(target);
      this.renderer.clear();
      this.renderer.render(scene, this.camera);
    }
    this.renderer.setRenderTarget(null);
    this.renderer.render(this.screen, this.screenCamera);
    this.drawLabels();
    this.drawAxes();
    this.drawScale();
  }

  distanceTo(place) {
    if (this.isParallel) return this.viewHeight;
    return this.camera.position.distanceTo(new THREE.Vector3(...place));
  }

  drawLabels() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const taken = [], shown = [];
    for (const [text, place, kind = ""] of this.labeled) {
      const at = new THREE.Vector3(...place).project(this.camera);
      if (Math.abs(at.x) > 1 || Math.abs(at.y) > 1 || Math.abs(at.z) > 1) continue;
      // Stations have their number on their mark; other labels are beside their mark.
      const on = kind.startsWith("station"), wide = 7 * text.length + (on ? 11 : 14), tall = on ? 18 : 22;
      const y = ((1 - at.y) / 2) * height - (on ? 9 : 24);
      const x = Math.max(0, Math.min(((at.x + 1) / 2) * width + (on ? -wide / 2 : 8), width - wide));
      const over = on ? 5 : 0; // number of pixels by which marks may overlap
      const [left, top, right, bottom] = [x + over, y + over, x + wide - over, y + tall - over];
      if (taken.some((box) => left < box[2] && box[0] < right && top < box[3] && box[1] < bottom)) continue;
      taken.push([left, top, right, bottom]);
      shown.push([text, x, y, kind]);
    }
    while (this.labels.children.length < shown.length) this.labels.append(element("span"));
    [...this.labels.children].forEach((label, k) => {
      label.hidden = k >= shown.length;
      if (label.hidden) return;
      const [text, x, y, kind] = shown[k];
      if (label.className !== kind) label.className = kind;
      if (label.textContent !== text) label.textContent = text;
      label.style.transform = `translate(${Math.round(x)}px, ${Math.round(y)}px)`;
    });
  }

  drawAxes() {
    const pen = this.axes.getContext("2d"), middle = 64, turn = this.camera.quaternion.clone().invert();
    pen.clearRect(0, 0, 128, 128);
    pen.lineWidth = 4;
    pen.font = "bold 22px system-ui, sans-serif";
    pen.textAlign = "center";
    pen.textBaseline = "middle";
    const axes = ["x", "y", "z"].map((name, axis) => [name, new THREE.Vector3().setComponent(axis, 1).applyQuaternion(turn), ["#d2404a", "#3f9a4d", "#3f74d0"][axis]]);
    for (const [name, way, color] of axes.sort((a, b) => a[1].z - b[1].z)) {
      pen.strokeStyle = pen.fillStyle = color;
      pen.beginPath();
      pen.moveTo(middle, middle);
      pen.lineTo(middle + 38 * way.x, middle - 38 * way.y);
      pen.stroke();
      pen.fillText(name, middle + 52 * way.x, middle - 52 * way.y);
    }
  }

  drawScale() {
    const meters = this.viewHeight / this.canvas.clientHeight;
    const most = 150 * meters, power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((n) => n * power).find((n) => n <= most);
    const [unit, size] = length >= 1000 ? ["km", 1000] : length >= 1 ? ["m", 1] : length >= 0.01 ? ["cm", 0.01] : ["mm", 0.001];
    this.scale.firstChild.textContent = `${+(length / size).toPrecision(2)} ${unit}`;
    this.scale.lastChild.style.width = `${Math.round(length / meters)}px`;
    this.scale.title = this.isParallel ? "scale" : "scale at the camera target";
  }

  // -- the mouse -------------------------------------------------------------------------

  // Returns the point under the mouse, {row, layer, place}, or null. Among the points on the front
  // surface, it is the one closest to the mouse.
  pick(x, y) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const m = this.matrix.elements, found = [];
    const { low, high } = this.pointMaterial.uniforms;
    for (const points of Object.values(this.layers)) {
      const p = points.told.arrays.positions;
      for (let k = 0; k < p.length; k += 3) {
        const w = m[3] * p[k] + m[7] * p[k + 1] + m[11] * p[k + 2] + m[15];
        if (w <= 0) continue;
        const across = (((m[0] * p[k] + m[4] * p[k + 1] + m[8] * p[k + 2] + m[12]) / w + 1) / 2) * width - x;
        if (Math.abs(across) > PICKED_WITHIN) continue;
        const down = ((1 - (m[1] * p[k] + m[5] * p[k + 1] + m[9] * p[k + 2] + m[13]) / w) / 2) * height - y;
        const away = Math.hypot(across, down);
        if (away > PICKED_WITHIN) continue;
        if ([0, 1, 2].some((axis) => p[k + axis] < low.value.getComponent(axis) || p[k + axis] > high.value.getComponent(axis))) continue;
        const depth = (m[2] * p[k] + m[6] * p[k + 1] + m[10] * p[k + 2] + m[14]) / w;
        found.push({ away, depth: this.isParallel ? depth : w, row: points.told.arrays.rows[k / 3], place: [p[k], p[k + 1], p[k + 2]] });
      }
    }
    if (!found.length) return null;
    const nearest = found.reduce((a, b) => (b.depth < a.depth ? b : a)).depth;
    const first = this.isParallel ? found.filter((one) => one.depth <= nearest + 0.01) : found.filter((one) => one.depth <= SAME_SURFACE * nearest);
    return first.reduce((a, b) => (b.away < a.away ? b : a));
  }

  // Returns the position on a surface under the mouse, [x, y, z], or null.
  surfaceAt(x, y) {
    if (!this.surface || !this.opacity) return null;
    const { clientWidth: width, clientHeight: height } = this.canvas, { low, high } = this.pointMaterial.uniforms;
    const [start, end] = [-1, 1].map((depth) => new THREE.Vector3((2 * x) / width - 1, 1 - (2 * y) / height, depth).unproject(this.camera));
    const way = end.sub(start), { geometry } = this.surface, p = geometry.attributes.position.array, index = geometry.index?.array;
    const [dx, dy, dz] = way.toArray(), [ox, oy, oz] = start.toArray();
    let nearest = Infinity;
    for (let k = 0, count = index?.length ?? p.length / 3; k < count; k += 3) { // Möller and Trumbore, 1997
      const a = 3 * (index ? index[k] : k), b = a + 3, c = a + 6;
      const e1x = p[b] - p[a], e1y = p[b + 1] - p[a + 1], e1z = p[b + 2] - p[a + 2];
      const e2x = p[c] - p[a], e2y = p[c + 1] - p[a + 1], e2z = p[c + 2] - p[a + 2];
      const hx = dy * e2z - dz * e2y, hy = dz * e2x - dx * e2z, hz = dx * e2y - dy * e2x;
      const det = e1x * hx + e1y * hy + e1z * hz;
      if (det === 0) continue;
      const sx = ox - p[a], sy = oy - p[a + 1], sz = oz - p[a + 2], u = (sx * hx + sy * hy + sz * hz) / det;
      if (!(u >= 0 && u <= 1)) continue;
      const qx = sy * e1z - sz * e1y, qy = sz * e1x - sx * e1z, qz = sx * e1y - sy * e1x, v = (dx * qx + dy * qy + dz * qz) / det;
      if (!(v >= 0 && u + v <= 1)) continue;
      const t = (e2x * qx + e2y * qy + e2z * qz) / det;
      if (!(t >= 0 && t < nearest)) continue;
      const inside = [ox + t * dx, oy + t * dy, oz + t * dz].every((value, axis) => value >= low.value.getComponent(axis) && value <= high.value.getComponent(axis));
      if (inside) nearest = t;
    }
    return nearest < Infinity ? start.addScaledVector(way, nearest).toArray() : null;
  }

  // places: positions of marked points, connected by lines; text: the measurement; closed: whether
  // a line connects the last point to the first
  mark(places, text = "", closed = false) {
    for (const mark of this.marks) if (mark.made) this.scene.remove(mark.made);
    const material = new THREE.MeshBasicMaterial({ color: MARK, depthTest: false });
    this.marks = places.map((place) => {
      const ball = new THREE.Mesh(new THREE.SphereGeometry(1, 16, 10), material);
      ball.position.set(...place);
      ball.renderOrder = 2;
      return { ball, made: ball, place };
    });
    const ends = places.slice(1).flatMap((place, k) => [...places[k], ...place]);
    if (closed && places.length > 2) ends.push(...places.at(-1), ...places[0]);
    if (ends.length) {
      const line = this.thickLines(ends, MARK, 3);
      line.material.depthTest = false;
      line.renderOrder = 1;
      const middle = [0, 1, 2].map((axis) => places.reduce((sum, place) => sum + place[axis], 0) / places.length);
      this.marks.unshift({ made: line, place: places.length === 3 && !closed ? places[1] : middle, text });
    }
    for (const mark of this.marks) this.scene.add(mark.made);
    this.dirty = true;
  }

  // -- the clip box ----------------------------------------------------------------------

  // A box with a handle on each side; moved(axis, end, value) is called when a handle is dragged.
  showClipBox(on, moved) {
    this.handles?.forEach(({ press }) => press.remove());
    if (this.clipEdges) this.scene.remove(this.clipEdges);
    this.handles = this.clipEdges = null;
    this.dirty = true;
    if (!on) return;
    this.handles = [0, 1, 2].flatMap((axis) => [0, 1].map((end) => this.makeHandle(axis, end, moved)));
    this.updateCamera();
    this.drawClipBox();
  }

  // Returns [lowest, highest] of the clip box along each axis, by default those of the scene.
  get clipEnds() {
    return this.clip.map(([low, high], axis) => [low ?? this.bounds[0].getComponent(axis), high ?? this.bounds[1].getComponent(axis)]);
  }

  makeHandle(axis, end, moved) {
    const press = element("button", { type: "button", title: `Drag the ${end ? "upper" : "lower"} limit of ${"xyz"[axis]}` });
    press.setAttribute("aria-label", `clip box, ${"xyz"[axis]}, ${end ? "highest" : "lowest"}`);
    const move = (by) => {
      const ends = this.clipEnds, value = ends[axis][end] + by;
      moved(axis, end, end ? Math.max(value, ends[axis][0]) : Math.min(value, ends[axis][1]));
    };
    press.onpointerdown = (event) => { press.setPointerCapture(event.pointerId); event.preventDefault(); press.focus(); };
    press.onpointermove = (event) => {
      if (!press.hasPointerCapture(event.pointerId)) return;
      const [x, y] = this.pixelsPerMeter(axis), squared = x * x + y * y;
      if (squared > 1e-6) move((event.movementX * x + event.movementY * y) / squared);
    };
    press.onkeydown = (event) => {
      const sign = { ArrowUp: 1, ArrowDown: -1 }[event.key];
      if (!sign) return;
      event.preventDefault();
      const [low, high] = [this.bounds[0], this.bounds[1]].map((corner) => corner.getComponent(axis));
      move((sign * (high - low)) / (event.shiftKey ? 20 : 100));
    };
    this.handlesBox.append(press);
    return { press, axis, end };
  }

  // Returns the position of a handle, which is the center of its side.
  handlePlace(axis, end) {
    const place = new THREE.Vector3(...this.clipEnds.map(([low, high]) => (low + high) / 2));
    return place.setComponent(axis, this.clipEnds[axis][end]);
  }

  pixelsOf(place) {
    const at = place.project(this.camera);
    return [((at.x + 1) / 2) * this.canvas.clientWidth, ((1 - at.y) / 2) * this.canvas.clientHeight, at.z];
  }

  // Returns how many pixels the center of the clip box moves in the view if it moves along an axis.
  pixelsPerMeter(axis) {
    const step = 1e-3 * this.extent, middle = new THREE.Vector3(...this.clipEnds.map(([low, high]) => (low + high) / 2));
    const [a, b] = [middle.clone(), middle.clone().setComponent(axis, middle.getComponent(axis) + step)].map((place) => this.pixelsOf(place));
    return [(b[0] - a[0]) / step, (b[1] - a[1]) / step];
  }

  drawClipBox() {
    if (!this.handles) return;
    if (this.clipEdges) this.scene.remove(this.clipEdges);
    const [min, max] = [0, 1].map((end) => new THREE.Vector3(...this.clipEnds.map((ends) => ends[end])));
    this.clipEdges = this.thinLines(edgesOf({ min, max }), CLIP);
    this.scene.add(this.clipEdges);
    for (const { press, axis, end } of this.handles) {
      const [x, y, depth] = this.pixelsOf(this.handlePlace(axis, end));
      press.hidden = Math.abs(depth) > 1;
      press.style.transform = `translate(${Math.round(x)}px, ${Math.round(y)}px)`;
    }
  }

  // Returns the view as a PNG file.
  save(name) {
    this.dirty = true;
    this.draw();
    this.canvas.toBlob((file) => saveFile(file, name));
  }
}
