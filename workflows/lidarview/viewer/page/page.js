// The page: requests to the server, the controls, and playback.
import { ask } from "./ask.js";
import { button, dual, element, explain, iconButton, legend, menu, number, saveFile, section, setIcon, slider, stepFor, themeButton, tick } from "./controls.js";
import { Picture, lastNotAbove } from "./picture.js";
import { count, follow, replace, slots, stop } from "./run.js";

const FIRST_LOOK = 200_000; // number of points in the first request
const POINTER_MS = 60; // time for which the mouse must rest before its position is determined
const REST_MS = 250; // time for which the camera must rest before points are requested
const NEWS_MS = 500;
const CACHED = 300e6; // memory for the points of single sweeps, in bytes
const AHEAD = 3; // number of sweeps that are requested in advance during playback
const GROWING = 300_000; // points of all sweeps up to the current time during playback
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 5, 10];
const BUDGETS = [0.2, 0.5, 1, 2, 5, 10, 20].map((millions) => millions * 1e6);
const SHOWS = [["all", "all points"], ["sweep", "one sweep"], [0.5, "last 0.5 s"], [2, "last 2 s"], [10, "last 10 s"], ["now", "all so far"]];
const HIDDEN = "hidden";
const OPEN = 3e38; // an end of a range without a limit, which fits into float32
const READING = "Loading points …"; // shown until the first points arrive
const FAINT = 0.2; // opacity of gray surfaces in front of points, so that the points remain visible
const NARROW = matchMedia("(max-width: 799px)"); // where the panel is a drawer

const $ = (id) => document.getElementById(id);
for (const kind of ["error", "unhandledrejection"])
  addEventListener(kind, ({ error, reason }) => { if (error ?? reason) failed(error ?? reason); });
const picture = new Picture($("canvas"), $("labels"), $("handles"), $("axes"), $("scale"), () => moved());
const theme = themeButton((chosenOne) => picture.setTheme(chosenOne));

// The user's choices, which a link stores.
const chosen = {
  color: "z", scene: "gray", filter: [], off: new Set(), show: "all", time: 0, speed: 1, loop: true, images: false,
  budget: 2e6, size: 1, shading: true, opacity: FAINT, boxes: true, clip: [[null, null], [null, null], [null, null]], rays: false, follow: false, tool: "point", limits: null, clipBox: false,
};
let state = null; // answer of the server: {…, arrays}
let sweeps = []; // [{first, last, begin, sensor, index}] in the order of their start times
let playing = false;
let drives = false; // whether the result has a moving vehicle
let picked = []; // points: {place, local, columns}

// -- the server --------------------------------------------------------------------------

let lost = false;
function failed(error) {
  if (error.name === "AbortError") return;
  console.warn(error);
  say(error.message, true);
  if (error instanceof TypeError) {
    lost = true;
    setPlaying(false);
  }
}

function sayRead() {
  if ($("hint").textContent === READING) say("");
}

// Shows the progress of a run, unless another message is shown.
let saidState = "";
function sayState(words) {
  if (["", READING, "Loading …", saidState].includes($("hint").textContent)) say(words);
  saidState = words;
}

function say(words, bad = false) {
  $("hint").textContent = words;
  $("hint").className = bad ? "bad" : "";
}

// -- points ------------------------------------------------------------------------------

const requests = { base: null, detail: null }; // requests in flight
const cache = new Map(); // {key: points of sweeps}, the last used at the end
let shownKey = null, restTimer = 0, complete = false;

function rangesAt(time) {
  const words = [];
  for (const [number, sensor] of picture.sensors.entries()) {
    if (!sensor.shown) continue;
    const own = sensor.sweeps;
    if (!own.length) continue;
    if (chosen.show === "all") {
      words.push(`${own[0].first}-${own.at(-1).last}`);
      continue;
    }
    const last = lastNotAbove(sensor.begins, time + 1e-9);
    if (last < 0) continue;
    let first = last;
    if (chosen.show === "now") first = 0;
    else if (chosen.show !== "sweep") first = Math.min(last, lastNotAbove(sensor.begins, time - +chosen.show) + 1);
    words.push(`${own[first].first}-${own[last].last}`);
  }
  return words.join(",");
}

const filterText = () => chosen.filter.map(String).join(";");

function questionAt(time) {
  const asked = { color: chosen.color === HIDDEN ? "z" : chosen.color };
  if (chosen.filter.length) asked.filter = filterText();
  if (chosen.limits) asked.limits = chosen.limits.join(",");
  const every = picture.sensors.every((sensor) => sensor.shown);
  if (sweeps.length && !(chosen.show === "all" && every)) asked.scans = rangesAt(time);
  return asked;
}

const keyOf = (asked) => JSON.stringify([asked, state.version, chosen.budget]);

// Shows the selected points, and returns whether they are already available.
function refresh() {
  if (!state) return true;
  const asked = questionAt(chosen.time), key = keyOf(asked);
  if (chosen.color === HIDDEN) {
    sayRead();
    for (const layer of ["base", "detail"]) picture.setPoints(layer, null);
    shownKey = null;
    tellFacts();
    return true;
  }
  if (key === shownKey) return true;
  if (chosen.show !== "all") return showSweeps(asked, key);
  shownKey = key;
  abort("detail");
  loadBase(asked).catch(failed);
  return true;
}

function abort(layer) {
  requests[layer]?.abort();
  requests[layer] = null;
}

async function load(layer, asked) {
  abort(layer);
  const request = (requests[layer] = new AbortController());
  try {
    return await ask("points", asked, request.signal);
  } finally {
    if (requests[layer] === request) {
      requests[layer] = null;
      tellFacts();
    }
  }
}

async function loadBase(asked) {
  tellFacts();
  const told = await load("base", { ...asked, most: Math.min(FIRST_LOOK, chosen.budget) });
  picture.setPoints("detail", null);
  picture.setPoints("base", told);
  sayRead();
  complete = told.arrays.rows.length >= told.count;
  showLegend(told.legend);
  tellFacts();
  if (!complete) await loadDetail();
}

// Requests more points: all if there are few enough, otherwise those in the view.
async function loadDetail() {
  const base = picture.layers.base?.told;
  if (!base || complete || chosen.show !== "all" || requests.base) return;
  const asked = { ...questionAt(chosen.time), most: chosen.budget };
  const all = base.count <= chosen.budget;
  if (!all) asked.eye = picture.matrix.elements.map((value) => +value.toPrecision(9)).join(",");
  const loading = load("detail", asked);
  tellFacts();
  const told = await loading;
  picture.setPoints("detail", told);
  if (all) {
    picture.setPoints("base", null);
    complete = true;
  }
  tellFacts();
}

function moved() {
  clearTimeout(restTimer);
  if (state && !complete && chosen.show === "all" && !playing)
    restTimer = setTimeout(() => { if (!requests.base) loadDetail().catch(failed); }, REST_MS);
}

function remember(key, told) {
  cache.delete(key);
  cache.set(key, told);
  const size = (one) => one.arrays.rows.length * 20;
  let sum = [...cache.values()].reduce((bytes, one) => bytes + size(one), 0);
  for (const [old, one] of cache) {
    if (sum <= CACHED || cache.size <= AHEAD + 1) break;
    cache.delete(old);
    sum -= size(one);
  }
}

const underWay = new Map(); // {key: promise}
function fetchSweeps(asked, key) {
  if (cache.has(key) || underWay.has(key)) return;
  const most = chosen.show === "now" && playing ? Math.min(GROWING, chosen.budget) : chosen.budget;
  const loading = ask("points", { ...asked, most })
    .then((told) => { remember(key, told); if (key === keyOf(questionAt(chosen.time))) refresh(); })
    .catch(failed)
    .finally(() => { underWay.delete(key); tellFacts(); });
  underWay.set(key, loading);
}

function showSweeps(asked, key) {
  abort("base");
  abort("detail");
  if (!cache.has(key)) {
    fetchSweeps(asked, key);
    return false;
  }
  const told = cache.get(key);
  remember(key, told);
  shownKey = key;
  complete = true;
  picture.setPoints("base", null);
  picture.setPoints("detail", told);
  sayRead();
  showLegend(told.legend);
  tellFacts();
  return true;
}

// -- the panel ---------------------------------------------------------------------------

const panel = { progress: element("div", { id: "progress" }) };

const onlyObject = (name) => {
  const limits = chosen.filter.find(([column]) => column === name);
  return limits && limits[1] === limits[2] ? limits[1] : null;
};

// Returns the values of a column that are switched off: filter entries that begin with "!".
const hiddenOf = (name) => new Set(chosen.filter.filter(([column]) => column === `!${name}`).map(([, value]) => value));
const ofColumn = (name) => ([column]) => column === name || column === `!${name}`;

let legendText = "";
function showLegend(told) {
  const text = JSON.stringify([told, chosen.filter]);
  if (text === legendText) return;
  legendText = text;
  const column = told?.column;
  panel.legend.replaceChildren(labels([HIDDEN, "result"].includes(chosen.color) ? null : told, column));
  if (told?.limits && chosen.color !== HIDDEN) panel.legend.append(limitInputs(told.limits));
  if (told?.labels?.length && column !== "result") tellCounts(panel.legend, column).catch(failed);
}

// Lets the user set the ends of the color scale.
function limitInputs(limits) {
  const inputs = limits.map((value, end) => {
    const input = element("input", { type: "number", step: "any", value: +value.toPrecision(6) });
    input.setAttribute("aria-label", end ? "upper limit of the color scale" : "lower limit of the color scale");
    input.onchange = () => {
      const ends = inputs.map((other) => other.valueAsNumber);
      if (!ends.every(Number.isFinite) || ends[0] >= ends[1]) return sayBriefly("The lower limit must be less than the upper limit.");
      return setColorLimits(ends);
    };
    return input;
  });
  const reset = chosen.limits ? [button("Auto", () => setColorLimits(null))] : [];
  return element("div", { className: "limits" }, ...inputs, ...reset);
}

function setColorLimits(limits) {
  chosen.limits = limits;
  legendText = "";
  refresh();
}

// Writes the number of points beside each label.
async function tellCounts(box, column) {
  const { counts, exact } = await ask("counts", { name: column });
  const known = new Map(counts);
  for (const shown of box.querySelectorAll(".legend .number"))
    shown.textContent = `${exact ? "" : "≈ "}${(known.get(+shown.dataset.value) ?? 0).toLocaleString("en")}`;
}

// Creates a legend whose labels select values of a column, or switch them off.
const labels = (told, column) => legend(
  told, onlyObject(column), (value) => toggle(column, value), column === "class" ? state.classes : {},
  hiddenOf(column), (value) => switchValue(column, value));

function switchValue(column, value) {
  const hidden = hiddenOf(column);
  if (hidden.has(value)) hidden.delete(value);
  else hidden.add(value);
  chosen.filter = [...chosen.filter.filter((entry) => !ofColumn(column)(entry)), ...[...hidden].map((each) => [`!${column}`, each, each])];
  afterFilter(column);
}

function toggle(column, value) {
  setLimits(column, onlyObject(column) === value ? null : [value, value]);
}

function tellFacts() {
  if (!state || !panel.facts) return;
  const layers = Object.values(picture.layers).map((points) => points.told);
  const some = layers[0]?.count ?? (chosen.color === HIDDEN ? state.points : 0);
  const count = state.sampled ? state.points : some; // during a run, only a part has been read
  const drawn = Math.min(picture.drawn, count), n = (value) => value.toLocaleString("en");
  const parts = [`<b>${n(count)} ${count === 1 ? "point" : "points"}</b>`];
  if (count < state.points) parts.push(`of ${n(state.points)}`);
  if (drawn < count && chosen.color !== HIDDEN) parts.push(`· ${n(drawn)} drawn`);
  panel.facts.innerHTML = parts.join(" ");
  if (requests.detail || requests.base || state.growing || (underWay.size && !playing)) panel.facts.append(" …");
}

function setLimits(name, limits) {
  chosen.filter = chosen.filter.filter((entry) => !ofColumn(name)(entry));
  if (limits) chosen.filter.push([name, ...limits]);
  afterFilter(name);
}

const objectLimits = () => chosen.filter.find(([name]) => name === "object")?.slice(1) ?? null;

// The labels select objects or materials of points.
function showSceneLegend() {
  const column = panel.sceneTold?.column ?? "object", acts = state.columns.some(({ name }) => name === column);
  panel.sceneLegend?.replaceChildren(acts ? labels(panel.sceneTold, column) : legend(panel.sceneTold, null, () => {}));
}

function afterFilter(name) {
  if (name === "object") picture.showObjects(objectLimits(), hiddenOf("object"));
  showSceneLegend();
  legendText = "";
  tellFilter();
  tellResults();
  refresh();
}

// The switch between several results.
function tellResults() {
  if (state.results.length) panel.results.replaceChildren(labels({ labels: state.results }, "result"));
}

function nextResult() {
  const now = onlyObject("result"), next = now === null ? 0 : now + 1;
  if (state.results.length) setLimits("result", next < state.results.length ? [next, next] : null);
}

function tellFilter() {
  panel.limits.replaceChildren(
    ...chosen.filter.map(([name, low, high]) => element("div", { className: "note", textContent: limitWords(name, low, high) })),
    ...(chosen.filter.length ? [button("Show all", () => {
      chosen.filter = [];
      picture.showObjects(null, new Set());
      legendText = "";
      tellFilter();
      tellResults();
      showFilterInput(panel.filterBy.menu.value).catch(failed);
      refresh();
    })] : []),
  );
}

const filterNames = {}; // {column: {value: name}}
function limitWords(name, low, high) {
  if (name.startsWith("!")) {
    const column = name.slice(1), names = column === "class" ? state.classes : filterNames[column] ?? {};
    return `${column}: without ${names[low] ?? number(low)}`;
  }
  const names = filterNames[name] ?? {};
  if (low === high) return `${name}: only ${names[low] ?? number(low)}`;
  const column = state.columns.find((one) => one.name === name), size = column?.unit === "s" ? 1e9 : 1;
  const [a, b] = [low, high].map((value) => (Math.abs(value) >= OPEN ? null : number(value / size)));
  return `${name}: ${a === null ? `up to ${b}` : b === null ? `from ${a}` : `${a} to ${b}`} ${column?.unit ?? ""}`;
}

async function showFilterInput(name) {
  const told = await ask("column", { name });
  const limits = chosen.filter.find(([column]) => column === name);
  if (told.labels) {
    filterNames[name] = Object.fromEntries(told.labels.map(([text, value]) => [value, text]));
    if (name === "class") Object.assign(filterNames[name], state.classes);
    const options = [["", "all"], ...told.labels.map(([, value]) => [value, filterNames[name][value]])];
    const only = limits && limits[1] === limits[2] ? limits[1] : "";
    panel.filterInput.replaceChildren(menu("only", options, only, (value) => setLimits(name, value === "" ? null : [+value, +value])));
    return;
  }
  const span = told.high - told.low, step = told.whole ? Math.max(1, Math.round(stepFor(span))) : stepFor(span);
  const low = Math.floor(told.low / step) * step, high = Math.max(Math.ceil(told.high / step) * step, low + step);
  const ends = limits ? [limits[1] / told.unit, limits[2] / told.unit] : [null, null];
  const apply = later((some) => setLimits(name, some.every((one) => one === null) ? null :
    [some[0] === null ? -OPEN : some[0] * told.unit, some[1] === null ? OPEN : some[1] * told.unit]));
  panel.filterInput.replaceChildren(dual("range", low, high, step, ends, (value) => number(value, step), apply));
}

function later(act, ms = 120) {
  let timer = 0;
  return (...values) => {
    clearTimeout(timer);
    timer = setTimeout(() => act(...values), ms);
  };
}

function buildPanel() {
  const columns = state.columns.map((column) => column.name);
  panel.facts = element("div", { id: "facts" });
  const name = state.title.replace(/ - lidarpool$/, "");
  const head = element(
    "header", {}, element("h1", { textContent: name }),
    iconButton("link", "Copy a link to this view", copyLink),
    iconButton("picture", "Save as image", () => picture.save(`${name}.png`)),
    iconButton("help", "Keyboard and mouse help (?)", showKeys), theme, iconButton("panel", "Hide the panel (H)", () => showPanel(false)),
  );
  panel.legend = element("div");
  const points = section("Points", true,
    (panel.color = menu("color", [...state.colors, HIDDEN], chosen.color, (value) => { chosen.color = value; chosen.limits = null; legendText = ""; refresh(); if (value === HIDDEN) showLegend(null); })),
    panel.legend,
    slider("size", -1, 1, 0.05, Math.log10(chosen.size), (value) => `${(10 ** value).toFixed(1)}×`, (value) => {
      chosen.size = picture.pointScale = 10 ** value;
      picture.sizePoints();
    }),
    menu("maximum", BUDGETS.map((count) => [count, `${(count / 1e6).toLocaleString("en")} million`]), chosen.budget, (value) => { chosen.budget = +value; shownKey = null; refresh(); }),
    tick("depth shading", chosen.shading, (on) => { chosen.shading = on; picture.strength = on ? 1 : 0; picture.dirty = true; }),
  );
  const parts = [head, panel.progress, ...(state.live ? [stop] : []), panel.facts];
  if (state.results.length) parts.push(section("Results", true, (panel.results = element("div"))));
  parts.push(points);
  if (state.scene_colors) {
    panel.sceneLegend = element("div");
    parts.push(section("Scene", true,
      menu("color", [...state.scene_colors, HIDDEN], chosen.scene, (value) => {
        chosen.scene = value;
        panel.opacity.set(value === "gray" ? FAINT : 1); // so that the color is visible
        loadSurface().catch(failed);
      }),
      panel.sceneLegend,
      (panel.opacity = slider("opacity", 0, 1, 0.05, chosen.opacity, (value) => `${Math.round(100 * value)} %`, (value) => {
        chosen.opacity = picture.opacity = value;
        picture.dirty = true;
      })),
      ...(state.scanner ? [] : [(panel.rays = tick("sample rays", chosen.rays, (on) => { chosen.rays = on; showRays(); }))]),
      ...(picture.actors.length ? [tick("boxes and names", chosen.boxes, (on) => { chosen.boxes = on; picture.showBoxes(on); })] : []),
    ));
  }
  if (picture.sensors.length) {
    panel.sensors = picture.sensors.map((sensor, k) => tick([sensor.name, sensor.model].filter(Boolean).join(": ") || `sensor ${k + 1}`, sensor.shown, (on) => {
      sensor.shown = on;
      if (on) chosen.off.delete(k); else chosen.off.add(k);
      picture.setTime(chosen.time);
      buildSteps();
      refresh();
      showImages();
    }));
    parts.push(section("Sensors", picture.sensors.length < 9, ...panel.sensors));
  }
  const sides = [["all", "All"], ["top", "Top"], ["side", "Side"], ["front", "Front"]].map(([side, text]) => button(text, () => look(side)));
  if (picture.sensors.length) sides.push(button("Sensor", () => look("sensor")));
  if (state.scanner) sides.push((clock.follow = button("Follow", () => setFollow(!chosen.follow))));
  panel.parallel = tick("parallel projection", false, (on) => picture.useParallel(on));
  parts.push(section("View", true, element("div", { className: "buttons" }, ...sides), panel.parallel));
  panel.point = element("div", { className: "note" });
  parts.push(section("Point", true, panel.point));
  panel.limits = element("div");
  panel.filterInput = element("div");
  panel.filterBy = menu("column", columns, columns.includes("object") ? "object" : columns[0], (name) => showFilterInput(name).catch(failed));
  const filter = section("Filter", chosen.filter.length > 0, panel.filterBy, panel.filterInput, panel.limits);
  filter.addEventListener("toggle", () => { if (filter.open) showFilterInput(panel.filterBy.menu.value).catch(failed); });
  panel.clip = element("div");
  parts.push(filter, section("Clip box", false, panel.clip, button("Show all", () => setClip([[null, null], [null, null], [null, null]]))));
  if (state.exports.length) {
    const format = menu("format", state.exports, state.exports[0], () => {});
    parts.push(section("Export", false, format, button("Download", () => download(format.menu.value).catch(failed)),
      element("div", { className: "note", textContent: "Exports the visible points, with the current filter, clip box and time." })));
  }
  $("panel").replaceChildren(...parts.flatMap((part) => (part === panel.facts && state.note ? [part, element("div", { className: "note", style: { padding: "0 12px 8px" }, textContent: state.note })] : [part])));
  buildClip();
  tellFilter();
  tellResults();
}

function showPanel(on) {
  if (state && panel.point) queueMicrotask(() => tellMeasured(measured(chosen.tool, picked.map((one) => one.place))));
  document.documentElement.classList.toggle("no-panel", !on);
}

// Lets the server write a file with the displayed points, and saves the file.
async function download(format) {
  const cut = chosen.clip.flatMap(([low, high], axis) => (low === null && high === null ? [] :
    [["xyz"[axis], low === null ? -OPEN : low + state.origin[axis], high === null ? OPEN : high + state.origin[axis]]]));
  const asked = { ...questionAt(chosen.time), format, filter: [...chosen.filter, ...cut].map(String).join(";") };
  say("Writing …");
  const told = await ask("export", asked);
  say(told.error ?? "", Boolean(told.error));
  if (!told.error) saveFile(new Blob([told.arrays.file]), told.name);
}

function look(side) {
  if (side === "sensor") picture.lookFromSensor();
  else picture.look(side);
  panel.parallel.box.checked = picture.isParallel;
}

function buildClip() {
  const names = ["x", "y", "z"];
  panel.clip.replaceChildren(...names.map((name, axis) => {
    const [low, high] = state.bounds.map((corner) => corner[axis] + state.origin[axis]);
    const step = stepFor(high - low), first = Math.floor(low / step) * step, last = Math.ceil(high / step + 1e-9) * step;
    const ends = chosen.clip[axis].map((value) => (value === null ? null : value + state.origin[axis]));
    return dual(`${name}, m`, first, last, step, ends, (value) => number(value, step), (some) => {
      chosen.clip[axis] = some.map((value) => (value === null ? null : value - state.origin[axis]));
      picture.setClip(chosen.clip);
    });
  }));
}

function setClip(limits) {
  chosen.clip = limits;
  picture.setClip(limits);
  buildClip();
}

async function loadSurface() {
  if (!state.scene_colors) return;
  const hidden = chosen.scene === HIDDEN;
  picture.actorsHidden = hidden;
  picture.colorActors(chosen.scene);
  const told = hidden ? null : await ask("surface", { color: chosen.scene });
  if (hidden !== (chosen.scene === HIDDEN)) return;
  picture.setSurface(told);
  picture.showObjects(picture.onlyObjects, picture.hiddenObjects);
  panel.sceneTold = told?.legend;
  showSceneLegend();
  if (told && !loadSurface.looked) {
    loadSurface.looked = true;
    loadSurface.floor = told.floor;
    const cut = Math.min(told.roof_cut ?? Infinity, state.cut ?? Infinity);
    if (Number.isFinite(cut) && !loadSurface.linked) setClip([[null, null], [null, null], [null, cut]]);
    if (told.roof_cut !== null) {
      picture.roofed = true; // from above, no wall obstructs the view
      if (!drives && !new URLSearchParams(location.hash.slice(1)).has("camera")) look("all");
    }
    showPath();
  }
}

// Rays belong to all sweeps.
function showRays() {
  picture.raysShown = chosen.rays && (chosen.show === "all");
  picture.showObjects(picture.onlyObjects, picture.hiddenObjects);
}

const showPath = () => picture.setPath(state.path, loadSurface.floor ?? state.box[0][2]);

// -- picked points and measurements ------------------------------------------------------

// {tool: [title, maximum number of points, what to click]}
const TOOLS = {
  point: ["Inspect a point (1)", 1, "Click a point to inspect it. Shift-click another point to measure the distance."],
  distance: ["Measure a distance (2)", 2, "Click two points."],
  angle: ["Measure an angle (3)", 3, "Click three points. The second is the vertex of the angle."],
  area: ["Measure an area (4)", 100, "Click the corners of the area."],
};

function buildTools() {
  const tools = Object.entries(TOOLS).map(([name, [title]]) => [name, iconButton(name, title, () => setTool(name))]);
  const clip = iconButton("clip", "Clip box (B): drag the faces", () => showClipBox(!chosen.clipBox));
  $("tools").replaceChildren(...tools.map(([, press]) => press), clip);
  panel.tools = { ...Object.fromEntries(tools), clip };
  tellTools();
}

function tellTools() {
  for (const name of Object.keys(TOOLS)) panel.tools[name].setAttribute("aria-pressed", chosen.tool === name);
  panel.tools.clip.setAttribute("aria-pressed", chosen.clipBox);
}

function setTool(name) {
  chosen.tool = name;
  picked = picked.slice(-1).slice(0, name === "point" ? 1 : 0);
  tellTools();
  showPicked();
}

function clearPicked() {
  picked = [];
  showPicked();
}

const less = (a, b) => a.map((value, axis) => value - b[axis]);
const length = (vector) => Math.hypot(...vector);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const digits = (value, unit, places = 3) => `${value.toLocaleString("en", { minimumFractionDigits: places, maximumFractionDigits: places })} ${unit}`;

// Returns the measurements between positions as [name, text], the main result first.
function measured(tool, places) {
  if (tool === "distance" && places.length === 2) {
    const way = less(places[1], places[0]);
    return [["distance", digits(length(way), "m")], ["horizontal", digits(Math.hypot(way[0], way[1]), "m")],
      ...["x", "y", "z"].map((axis, k) => [`Δ${axis}`, digits(way[k], "m")])];
  }
  if (tool === "angle" && places.length === 3) {
    const [a, b] = [less(places[0], places[1]), less(places[2], places[1])];
    const cosine = a.reduce((sum, value, k) => sum + value * b[k], 0) / (length(a) * length(b) || 1);
    return [["angle", digits((Math.acos(Math.min(1, Math.max(-1, cosine))) * 180) / Math.PI, "°", 2)],
      ["sides", `${digits(length(a), "m")}, ${digits(length(b), "m")}`]];
  }
  if (tool === "area" && places.length > 2) { // half the sum of cross products, in any plane
    const round = places.map((place, k) => [less(place, places[0]), less(places[(k + 1) % places.length], places[0])]);
    const sum = round.map(([a, b]) => cross(a, b)).reduce((a, b) => a.map((value, k) => value + b[k]));
    return [["area", digits(length(sum) / 2, "m²")], ["seen from above", digits(Math.abs(sum[2]) / 2, "m²")],
      ["outline", digits(round.reduce((total, [a, b]) => total + length(less(b, a)), 0), "m")]];
  }
  return [];
}

// Responds to a click at once, with a mark on the point or a message if there is no point.
async function pick(x, y, measure) {
  const found = picture.pick(x, y);
  if (!found) {
    if (chosen.tool === "point") clearPicked();
    return sayBriefly("There is no point here.");
  }
  if (measure && chosen.tool === "point" && picked.length) {
    chosen.tool = "distance";
    tellTools();
  }
  const one = { local: found.place, place: found.place.map((value, axis) => value + state.origin[axis]), columns: [["", "…"]] };
  const isFull = picked.length >= TOOLS[chosen.tool][1];
  picked = isFull && chosen.tool !== "area" ? [one] : [...picked, one];
  showPicked();
  const told = await ask("point", { row: found.row });
  Object.assign(one, { place: told.place, columns: told.columns });
  if (picked.includes(one)) showPicked();
}

function showPicked() {
  const rows = measured(chosen.tool, picked.map((one) => one.place)), text = rows[0]?.[1] ?? "";
  const point = picked.at(-1), advice = TOOLS[chosen.tool][2];
  tellMeasured(rows);
  if (point) ["x", "y", "z"].forEach((axis, k) => rows.push([axis, digits(point.place[k], "m")]));
  if (point) rows.push(...point.columns);
  picture.mark(picked.map((one) => one.local), text, chosen.tool === "area");
  if (!rows.length) panel.point.replaceChildren(advice);
  else panel.point.replaceChildren(element("table", { className: "point" }, ...rows.map(([name, value]) =>
    element("tr", {}, element("td", { textContent: name }), element("td", { textContent: value })))));
}

// Shows the result beside the tools, because the panel may be hidden.
function tellMeasured(rows) {
  const point = picked.at(-1), box = $("measured");
  const lines = rows.length ? rows.map(([name, words]) => `${name} ${words}`)
    : point && chosen.tool === "point" ? [point.place.map((value) => digits(value, "m")).join(", "), ...point.columns.map((pair) => pair.join(" "))]
      : [TOOLS[chosen.tool][2]];
  box.hidden = chosen.tool === "point" && !(point && document.documentElement.classList.contains("no-panel"));
  const clear = iconButton("close", "Clear (Esc)", () => { clearPicked(); if (chosen.tool !== "point") setTool("point"); });
  box.replaceChildren(element("div", {}, ...lines.map((line, k) => element(k ? "div" : "b", { textContent: line }))), clear);
}

let briefly = 0;
function sayBriefly(words) {
  say(words);
  clearTimeout(briefly);
  briefly = setTimeout(() => say(""), 2500);
}

// -- the clip box ------------------------------------------------------------------------

function showClipBox(on) {
  chosen.clipBox = on;
  picture.showClipBox(on, (axis, end, value) => {
    chosen.clip[axis][end] = value;
    picture.setClip(chosen.clip);
    buildClip();
  });
  tellTools();
}

// -- time --------------------------------------------------------------------------------

const SAME_TIME_S = 1e-3; // the time is displayed in milliseconds
let steps = []; // start times of the sweeps of displayed sensors, ascending
let stationAt = new Map(); // {start time of a sweep: its station}
const clock = {};

function buildSteps() {
  const shown = sweeps.filter((sweep) => picture.sensors[sweep.sensor]?.shown);
  stationAt = new Map(shown.map((sweep) => [sweep.begin, sweep.station]));
  const begins = [...stationAt.keys()].sort((a, b) => a - b);
  // Sweeps of several sensors that start at almost the same time are one step, at the start of the last.
  const gaps = picture.sensors.filter((sensor) => sensor.shown).flatMap(({ begins: own }) => [...own].map((begin, k) => begin - own[k - 1]).filter((gap) => gap > 0));
  const slack = gaps.reduce((least, gap) => Math.min(least, gap / 2), SAME_TIME_S);
  steps = [];
  let first = -Infinity;
  for (const begin of begins) {
    if (begin - first < slack) steps.pop();
    else first = begin;
    steps.push(begin);
  }
  if (!clock.ticks) return;
  if (stationary()) clock.slider.max = sliderEnd();
  drawTicks();
}

// The slider selects a time or, if the sensor only moves between stations, the number of a sweep.
const stationary = () => state.stations.length > 0;
const duration = () => Math.max(state.duration, 1e-9);
const sliderEnd = () => (stationary() ? Math.max(steps.length - 1, 1) : duration());
const stepNow = () => Math.max(lastNotAbove(steps, chosen.time + 1e-9), 0);

function buildTime() {
  const timed = sweeps.length > 0 && picture.sensors.length > 0;
  $("time").hidden = !timed;
  if (!timed) return;
  clock.play = iconButton("play", "Play (space)", () => setPlaying(!playing));
  const shows = SHOWS.filter(([value]) => !(+value >= (stationary() ? 0 : state.duration)))
    .map(([value, text]) => [value, value === "sweep" && steps.length === state.stations.length - 1 ? "one station" : text]);
  clock.show = menu("", shows, chosen.show, (value) => { clock.own = true; setShow(value); });
  explain(clock.show, "Visible points");
  clock.slider = element("input", { type: "range", min: 0, max: sliderEnd(), step: stationary() ? 1 : "any", value: stationary() ? stepNow() : chosen.time });
  explain(clock.slider, stationary() ? "Station" : "Time, seconds");
  clock.slider.oninput = () => { leaveAll(); setTime(stationary() ? steps[+clock.slider.value] : +clock.slider.value); };
  clock.ticks = element("canvas");
  clock.now = element("span", { className: "now" });
  clock.speed = menu("", SPEEDS.map((speed) => [speed, `${speed}×`]), chosen.speed, (value) => { chosen.speed = +value; });
  explain(clock.speed, stationary() ? "Playback speed (1× is one station per second)" : "Playback speed (1× is real time)");
  clock.loop = iconButton("loop", "Loop", () => { chosen.loop = !chosen.loop; showToggles(); });
  clock.follow = button("Follow", () => setFollow(!chosen.follow));
  clock.follow.title = "Follow the platform with the camera";
  clock.follow.hidden = !picture.sensors.some((sensor) => sensor.moves);
  clock.images = button("Range image", () => { chosen.images = !chosen.images; showToggles(); showImages(); });
  clock.images.hidden = Boolean(state.offline); // not available in an exported page
  $("time").replaceChildren(
    element("div", { className: "line" }, clock.slider, clock.ticks),
    element("div", { className: "transport" },
      iconButton("back", "Previous sweep (←)", () => stepBy(-1)), clock.play, iconButton("next", "Next sweep (→)", () => stepBy(1)), clock.speed, clock.loop),
    clock.now,
    element("div", { className: "options" }, clock.show, clock.follow, clock.images),
  );
  new ResizeObserver(drawTicks).observe(clock.ticks);
  showToggles();
}

// Moves the camera behind the vehicle, where it stays while the vehicle drives and turns.
function setFollow(on) {
  chosen.follow = picture.follow = on;
  if (on) look("sensor");
  showToggles();
}

function showToggles() {
  for (const [control, on] of [[clock.loop, chosen.loop], [clock.follow, chosen.follow], [clock.images, chosen.images]])
    control?.setAttribute("aria-pressed", on);
}

function drawTicks() {
  const { clientWidth: width, clientHeight: height } = clock.ticks, ratio = devicePixelRatio;
  if (!width) return;
  Object.assign(clock.ticks, { width: width * ratio, height: height * ratio });
  const pen = clock.ticks.getContext("2d"), style = getComputedStyle(document.body);
  pen.scale(ratio, ratio);
  const room = 8, at = (time) => room + (width - 2 * room) * (time / duration()); // a thumb is 16 pixels wide
  pen.fillStyle = style.getPropertyValue("--line");
  if (stationary()) {
    pen.fillStyle = style.getPropertyValue("--muted");
    pen.font = "11px system-ui, sans-serif";
    pen.textAlign = "center";
    let free = 0; // first position without a label
    steps.forEach((time, k) => {
      const x = room + ((width - 2 * room) * k) / sliderEnd();
      if (x < free || stationAt.get(time) === stationAt.get(steps[k - 1])) return;
      pen.fillText(stationAt.get(time), x, 14);
      free = x + 24;
    });
    return;
  }
  if (steps.length < width / 3) for (const time of steps) pen.fillRect(at(time), 0, 1, 4);
  if (!state.duration) return; // a single sweep of a cloud has an unknown duration
  const most = width / 70, step = [1, 2, 5, 10].map((n) => n * 10 ** Math.floor(Math.log10(duration() / most))).find((n) => duration() / n <= most);
  pen.fillStyle = style.getPropertyValue("--muted");
  pen.font = "11px system-ui, sans-serif";
  for (let time = 0; time <= duration() * 1.0001; time += step) {
    pen.textAlign = time === 0 ? "left" : at(time) > width - 20 ? "right" : "center";
    pen.fillText(`${number(time, step)} s`, Math.min(Math.max(at(time), 0), width), 14);
    pen.fillRect(at(time), 0, 1, 4);
  }
}

function setShow(value) {
  chosen.show = value;
  showRays();
  clock.show.value = value;
  shownKey = null;
  refresh();
  showImages();
  tellTime();
}

// Playing and stepping show single sweeps, unless the user has chosen another mode.
function leaveAll() {
  if (chosen.show === "all" && !clock.own && !state.preview) setShow("sweep");
}

function setTime(time) {
  chosen.time = Math.min(Math.max(time, 0), duration());
  clock.slider.value = stationary() ? stepNow() : chosen.time;
  picture.setTime(chosen.time);
  tellTime();
  const ready = refresh();
  showImages();
  return ready;
}

function tellTime() {
  const digits = duration() < 100 ? 3 : 1, index = stepNow(), station = stationAt.get(steps[index]), last = state.stations.length - 1;
  const of = steps.length === last ? "" : ` · sweep ${index + 1} of ${steps.length}`, name = state.stations[station];
  clock.now.textContent = stationary() ? `station ${station} of ${last}${name === `station ${station}` ? "" : ` · ${name}`}${of}`
    : `${chosen.time.toFixed(digits)} s · sweep ${index + 1} of ${steps.length}`;
}

function stepBy(count) {
  if (!steps.length) return;
  setPlaying(false);
  leaveAll();
  const index = stepNow();
  const back = count < 0 && chosen.time - steps[index] > 1e-6 ? 1 : 0;
  setTime(steps[Math.min(Math.max(index + count + back, 0), steps.length - 1)]);
}

function setPlaying(on) {
  if (on === playing || (on && (lost || !steps.length))) return;
  playing = on;
  setIcon(clock.play, on ? "pause" : "play");
  clock.play.title = on ? "Pause (space)" : "Play (space)";
  if (!on) return moved();
  leaveAll();
  if (chosen.time >= duration() - 1e-6) setTime(0);
}

// Playback waits until the points of a sweep have arrived.
function play(seconds) {
  let time = chosen.time + seconds * chosen.speed, ended = time >= duration();
  if (stationary()) {
    clock.waited = (clock.waited ?? 0) + seconds * chosen.speed;
    if (clock.waited < 1) return;
    clock.waited = 0;
    ended = stepNow() + 1 >= steps.length;
    time = ended ? steps[0] : steps[stepNow() + 1];
  }
  if (ended) {
    if (!chosen.loop) {
      setTime(duration());
      setPlaying(false);
      return;
    }
    time = 0;
  }
  if (chosen.show !== "all" && chosen.color !== HIDDEN) {
    const next = lastNotAbove(steps, time + 1e-9);
    for (let k = 0; k <= AHEAD; k++) {
      const asked = questionAt(k ? steps[(next + k) % steps.length] : time);
      fetchSweeps(asked, keyOf(asked));
    }
    if (!cache.has(keyOf(questionAt(time)))) return;
  }
  setTime(time);
}

// -- range images ------------------------------------------------------------------------

const images = new Map(); // {sensor: {sweep, canvas, caption}}
const MOST_IMAGES = 3;

function showImages() {
  const box = $("images");
  const on = chosen.images && !state.offline && sweeps.length > 0 && picture.sensors.some((sensor) => sensor.shown);
  box.hidden = !on;
  if (!on) return;
  const shown = [...picture.sensors.entries()].filter(([, sensor]) => sensor.shown && sensor.sweeps.length).slice(0, MOST_IMAGES);
  for (const [number, { figure }] of images) figure.hidden = !shown.some(([other]) => other === number);
  for (const [number, sensor] of shown) {
    const index = lastNotAbove(sensor.begins, chosen.time + 1e-9);
    if (index < 0) continue;
    if (!images.has(number)) {
      const canvas = element("canvas", { width: 1, height: 1 }), bar = element("i"), words = element("span");
      const figure = element("figure", {}, element("figcaption", {}, element("b", { textContent: sensor.name || sensor.model || "sensor" }), words, bar), canvas);
      box.append(figure);
      images.set(number, { canvas, words, bar, figure, sweep: -1, wanted: -1, busy: false });
    }
    const image = images.get(number);
    image.wanted = sensor.sweeps[index].index;
    loadImage(image).catch(failed);
  }
}

async function loadImage(image) {
  if (image.busy || image.wanted === image.sweep) return;
  image.busy = true;
  try {
    while (image.wanted !== image.sweep) {
      const sweep = image.wanted, told = await ask("range", { sweep });
      const [height, width] = told.arrays.image.shape;
      Object.assign(image.canvas, { width, height });
      image.canvas.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(told.arrays.image), width, height), 0, 0);
      image.words.textContent = `range, ${number(told.low, 0.1)} to ${number(told.high, 0.1)} m`;
      image.bar.style.background = "linear-gradient(to right,#fde725,#5ec962,#21918c,#3b528b,#440154)";
      image.sweep = sweep;
    }
  } finally {
    image.busy = false;
  }
}

// -- links -------------------------------------------------------------------------------

function linkText() {
  const { position } = picture.camera, { target } = picture.controls;
  const three = (place) => place.toArray().map((value) => +value.toPrecision(7)).join(",");
  const words = {
    camera: `${three(position)};${three(target)}`, color: chosen.color, scene: chosen.scene, show: chosen.show, opacity: chosen.opacity, time: chosen.time.toFixed(6),
    clip: chosen.clip.map((pair) => pair.map((value) => value ?? "").join(",")).join(";"), size: chosen.size.toFixed(3),
    images: chosen.images, follow: chosen.follow, rays: chosen.rays,
  };
  if (chosen.limits) words.limits = chosen.limits.join(",");
  if (chosen.clipBox) words.box = true;
  if (chosen.tool !== "point" || picked.length) words.measure = [chosen.tool, ...picked.map((one) => one.place.map((value) => +value.toFixed(4)).join(","))].join(";");
  if (picture.isParallel) words.parallel = picture.viewHeight.toPrecision(7);
  if (chosen.filter.length) words.filter = filterText();
  if (chosen.off.size) words.off = [...chosen.off].join(",");
  return new URLSearchParams(words).toString();
}

let written = location.hash; // the state that this page has last read or written

function writeLink(words) {
  history.replaceState(null, "", `#${words}`);
  written = location.hash;
}

async function copyLink() {
  writeLink(linkText());
  try {
    await navigator.clipboard.writeText(location.href);
    sayBriefly("A link to this view was copied.");
  } catch {
    sayBriefly("The link is in the address bar.");
  }
}

// The URL stores the view, so that it can be shared and opened again.
let linked = "";
function keepLink() {
  if (playing || lost || state.live || document.documentElement.classList.contains("plain")) return;
  if (location.hash !== written) return; // the user has entered another link, which reloads the page
  const words = linkText();
  if (words !== linked && linked) writeLink(words);
  linked = words;
}

function readLink() {
  const words = new URLSearchParams(location.hash.slice(1));
  const columns = state.columns.map((column) => column.name), get = (name) => words.get(name) ?? "";
  if ([...state.colors, HIDDEN].includes(get("color"))) chosen.color = get("color");
  if ([...(state.scene_colors ?? []), HIDDEN].includes(get("scene"))) chosen.scene = get("scene");
  if (SHOWS.some(([value]) => `${value}` === get("show"))) { chosen.show = get("show"); clock.own = true; }
  if (get("size")) chosen.size = picture.pointScale = Math.min(10, Math.max(0.1, +get("size") || 1));
  chosen.opacity = words.has("opacity") ? Math.min(1, Math.max(0, +get("opacity") || 0)) : chosen.scene === "gray" ? FAINT : 1;
  chosen.time = Math.min(Math.max(+get("time") || 0, 0), state.duration);
  for (const name of ["images", "follow", "rays"]) if (words.has(name)) chosen[name] = get(name) === "true";
  picture.follow = chosen.follow;
  const ends = get("limits").split(",").map(Number);
  if (ends.length === 2 && ends[0] < ends[1]) chosen.limits = ends;
  chosen.clipBox = get("box") === "true";
  const [tool, ...corners] = get("measure").split(";");
  if (TOOLS[tool]) {
    chosen.tool = tool;
    picked = corners.map((corner) => corner.split(",").map(Number)).filter((place) => place.length === 3 && place.every(Number.isFinite))
      .map((place) => ({ place, local: less(place, state.origin), columns: [] }));
  }
  for (const entry of get("filter").split(";").filter(Boolean)) {
    const [name, low, high] = entry.split(",");
    if (columns.includes(name.replace(/^!/, "")) && Number.isFinite(+low) && Number.isFinite(+high)) chosen.filter.push([name, +low, +high]);
  }
  for (const k of get("off").split(",").filter(Boolean)) if (picture.sensors[k]) { chosen.off.add(+k); picture.sensors[k].shown = false; }
  if (words.has("clip")) {
    loadSurface.linked = true;
    const pairs = get("clip").split(";").map((pair) => pair.split(",").map((value) => (value === "" || !Number.isFinite(+value) ? null : +value)));
    if (pairs.length === 3 && pairs.every((pair) => pair.length === 2)) chosen.clip = pairs;
  }
  return words;
}

function readCamera(words) {
  const places = (words.get("camera") ?? "").split(";").map((place) => place.split(",").map(Number));
  if (places.length !== 2 || places.flat().length !== 6 || !places.flat().every(Number.isFinite)) return;
  const { position, controls } = { position: picture.camera.position.clone(), controls: picture.controls };
  picture.place(position.fromArray(places[0]), controls.target.clone().fromArray(places[1]));
  const height = +words.get("parallel");
  if (height > 0) {
    picture.useParallel(true);
    Object.assign(picture.parallel, { top: height / 2, bottom: -height / 2, zoom: 1 });
    picture.resize();
    panel.parallel.box.checked = true;
  }
}

// -- start-up, updates from a run, and frames ---------------------------------------------

function takeState(told) {
  state = told;
  const { arrays } = told;
  const own = state.sensors.map((sensor, k) => ({
    ...sensor, shown: !chosen.off.has(k), times: arrays[`sensor${k}_times`], places: arrays[`sensor${k}_places`], sweeps: [], begins: [],
  }));
  sweeps = [];
  if (arrays.sweep_scans) {
    arrays.sweep_begins.forEach((begin, index) => {
      const sweep = { first: arrays.sweep_scans[index], last: arrays.sweep_scans[index + 1] - 1, begin, sensor: arrays.sweep_sensor[index], station: arrays.sweep_station[index], index };
      sweeps.push(sweep);
      own[sweep.sensor]?.sweeps.push(sweep);
    });
    for (const sensor of own) sensor.begins = Float64Array.from(sensor.sweeps, (sweep) => sweep.begin);
  }
  picture.setSensors(own);
  const actors = state.actors.map((actor, k) => ({
    label: [actor.name, state.classes[actor.class] ?? ""].filter(Boolean).join(" · "), object: state.statics + k, color: state.actor_colors[k],
    corners: arrays[`mesh${arrays.actor_mesh[k]}_corners`], own: arrays[`mesh${arrays.actor_mesh[k]}_colors`],
    times: arrays[`actor${k}_times`], places: arrays[`actor${k}_places`], turns: arrays[`actor${k}_turns`],
    there: arrays[`actor${k}_there`], frames: arrays[`actor${k}_frames`],
    poses: arrays[`mesh${arrays.actor_mesh[k]}_poses`], faces: arrays[`mesh${arrays.actor_mesh[k]}_faces`],
  }));
  // Labeled objects have no surface: their corners only span the box.
  const labeled = state.labeled.map(({ name }, k) => ({
    label: name, object: null, color: state.labeled_colors[k],
    corners: Float32Array.from([-1, 1, 1].flatMap((side) => [...arrays[`labeled${k}_size`]].map((length) => (side * length) / 2))),
    times: arrays[`labeled${k}_times`], places: arrays[`labeled${k}_places`], turns: arrays[`labeled${k}_turns`],
    there: arrays[`labeled${k}_there`],
  }));
  picture.setActors([...actors, ...labeled]);
  picture.setRays(arrays.rays);
  document.title = state.title;
}

// Places the sensors and actors of a scanner as in its last sweep, at a time in seconds.
function placeMoved(arrays, time) {
  const times = Float64Array.of(time), part = (name, k, size) => arrays[name].subarray(size * k, size * k + size);
  for (const [k, sensor] of picture.sensors.entries()) {
    Object.assign(sensor, { times: arrays[`sensor${k}_times`], places: arrays[`sensor${k}_places`] });
    picture.drawWay(sensor);
  }
  for (const [k, actor] of picture.actors.entries()) {
    Object.assign(actor, { times, places: part("actor_places", k, 3), turns: part("actor_turns", k, 4), frames: part("actor_frames", k, 1) });
    actor.there = arrays.actor_there[k] ? [-Infinity, Infinity] : [1, 0];
  }
  picture.setTime(time);
}

// Handles updates from a run or a scanner.
const known = { rays: null, hits: null, ends: 0, over: false };
async function news(told) {
  if (told.rays_version !== known.rays) {
    known.rays = told.rays_version;
    picture.setRays(told.arrays.rays);
  }
  tellRun(told);
  if (told.over && panel.rays?.box.checked && !known.over) panel.rays.box.click(); // rays would hide the points of a result
  known.over = told.over;
  if (told.arrays.actor_places) placeMoved(told.arrays, told.time);
  else if (told.time !== null && !told.over) picture.setTime(told.time);
  state.points = told.points;
  if (told.version !== state.version && told.ends === known.ends) {
    state.version = told.version;
    if (chosen.show === "all") await loadBase(questionAt(0));
  }
  if (chosen.scene === "hits" && told.hits_version !== known.hits) {
    known.hits = told.hits_version;
    await loadSurface();
  }
  if (told.path && !state.path) {
    state.path = told.path;
    showPath();
  }
  if (told.ends !== known.ends) {
    known.ends = told.ends;
    cache.clear();
    takeState(await ask("state"));
    if (state.by_sweep && !clock.own) chosen.show = "sweep";
    picture.setTime(chosen.time);
    buildSteps();
    buildPanel();
    buildTime();
    showPicked();
    picture.resize(); // the player needs space
    if (!picture.touched) look("all");
    if (!$("time").hidden) tellTime();
    legendText = "";
    shownKey = null;
    refresh();
    await loadSurface();
  }
}

// For a large file, a sample is shown first, and more points as they are read.
async function grow() {
  const told = await follow("growth", () => ({}), NEWS_MS, ({ complete: all, error, share, version }) => {
    say(`Loading points … ${Math.round(100 * share)} %`);
    if (all || error) return true;
    if (version !== state.version) {
      state.version = version;
      refresh();
    }
    return false;
  });
  say(told.error, Boolean(told.error));
  if (told.error) return;
  const { origin } = state;
  takeState(await ask("state"));
  if (picture.touched) picture.shift(less(origin, state.origin));
  else picture.frame(state.box, state.arrays.corners, state.bounds); // the sample does not cover all of the cloud
  buildPanel();
  showPicked();
  legendText = "";
  shownKey = null;
  refresh();
}

function tellRun(told) {
  const since = told.seconds === null ? "" : `, ${number(told.seconds, 1)} s`;
  const pace = told.rate && !told.over ? `, ${told.rate}${told.left && `, ${told.left} left`}` : "";
  const [, done, whole] = told.stages.at(-1) ?? [];
  if (told.title) document.title = `${told.over || !whole ? "" : `${Math.floor((100 * done) / whole)}% `}${told.title}${told.title === "lidarpool" ? "" : " - lidarpool"}`;
  sayState(told.over || (!NARROW.matches && told.points) ? "" : told.state);
  const head = element("div", {}, element("b", { textContent: told.state }), since, pace);
  replace(panel.progress, head, ...(told.over ? [] : told.stages.map(count)), ...told.slots.map(slots));
}

// -- keys and the mouse ------------------------------------------------------------------

const isTextField = (target) => target.isContentEditable || target.tagName === "TEXTAREA" || (target.tagName === "INPUT" && ["text", "number", "search"].includes(target.type));

// Keys work regardless of the focus, except in text fields. Enter presses the focused control, and the
// up and down keys change a focused slider or menu.
function keys(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || isTextField(event.target)) return;
  const { target, key } = event;
  if ($("keys").open && key !== "?") return;
  const acts = {
    "?": showKeys, Enter: target.type === "checkbox" ? () => target.click() : null,
    " ": () => setPlaying(!playing), ArrowLeft: () => stepBy(event.shiftKey ? -10 : -1), ArrowRight: () => stepBy(event.shiftKey ? 10 : 1),
    Home: () => stepBy(-1e9), End: () => stepBy(1e9), a: () => look("all"), t: () => look("top"), s: () => look("side"), f: () => look("front"),
    h: () => showPanel(document.documentElement.classList.contains("no-panel")), r: nextResult, 1: () => setTool("point"), 2: () => setTool("distance"), 3: () => setTool("angle"), 4: () => setTool("area"), b: () => showClipBox(!chosen.clipBox),
    Escape: () => { clearPicked(); if (chosen.tool !== "point") setTool("point"); },
    p: () => { picture.useParallel(!picture.isParallel); panel.parallel.box.checked = picture.isParallel; }, c: copyLink,
  };
  const timed = [" ", "ArrowLeft", "ArrowRight", "Home", "End"];
  const act = acts[key.length === 1 ? key.toLowerCase() : key];
  if (!act || (timed.includes(key) && $("time").hidden)) return;
  event.preventDefault();
  act();
}

// Buttons react to the space key when it is released.
function releaseKey(event) {
  if (event.key === " " && !$("time").hidden && !isTextField(event.target)) event.preventDefault();
}

const KEYS = [
  ["Space", "play or pause"], ["← →", "previous or next sweep; ten sweeps with Shift"], ["Home End", "first or last sweep"],
  ["A T S F", "fit all, top, side or front view"], ["P", "toggle parallel projection"], ["C", "copy a link to this view"],
  ["1 2 3 4", "inspect a point; measure a distance, an angle or an area"], ["Esc", "clear measurements"], ["B", "toggle the clip box"],
  ["H", "toggle the panel"], ["R", "next result, or all results"], ["Enter", "activate the focused button"],
  ["↑ ↓", "change the focused slider or menu"], ["?", "toggle this help"],
];
const GESTURES = [
  ["drag", "rotate; pan with two fingers, the right button or Shift"], ["wheel, pinch", "zoom"],
  ["click, tap", "inspect a point, or add a point to the measurement"], ["Shift-click", "measure the distance to another point"],
];

function showKeys() {
  const box = $("keys");
  if (box.open) {
    box.close();
    return;
  }
  const shown = KEYS.filter(([names]) => names !== "R" || state?.results.length);
  const kbd = (names) => names.split(" ").flatMap((name, k) => [...(k ? [" "] : []), element("kbd", { textContent: name })]);
  const line = (head, words) => [element("dt", {}, ...head), element("dd", { textContent: words })];
  box.replaceChildren(
    element("h2", { textContent: "Keys" }), element("dl", {}, ...shown.flatMap(([names, words]) => line(kbd(names), words))),
    element("h2", { textContent: "Mouse and touch" }), element("dl", {}, ...GESTURES.flatMap(([name, words]) => line([name], words))),
    button("Close", () => box.close()),
  );
  box.showModal();
}

let pressed = null;
function mouse() {
  const canvas = $("canvas");
  canvas.addEventListener("pointerdown", (event) => { pressed = event.button === 0 ? [event.offsetX, event.offsetY] : null; canvas.focus(); });
  canvas.addEventListener("pointerup", (event) => {
    if (pressed && Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) < 4) pick(event.offsetX, event.offsetY, event.shiftKey).catch(failed);
    pressed = null;
  });
  canvas.addEventListener("pointermove", tellPlace);
  canvas.addEventListener("pointerleave", () => { clearTimeout(restingTimer); showPlace(); });
}

// Shows the coordinates under the mouse once it rests, because finding the point takes up to 0.2 s.
let restingTimer = 0;
function tellPlace(event) {
  clearTimeout(restingTimer);
  if (event.pointerType === "touch" || event.buttons) return;
  const { offsetX: x, offsetY: y } = event;
  restingTimer = setTimeout(() => {
    const point = picture.pick(x, y)?.place, place = point ?? picture.surfaceAt(x, y);
    showPlace(place?.map((value, axis) => value + state.origin[axis]), point ? 3 : surfacePlaces());
  }, POINTER_MS);
}

// Number of decimals that are reliable on surfaces, which are drawn up to 2 cm further inward.
function surfacePlaces() {
  const inwards = Math.min(1e-4 * length(less(state.bounds[1], state.bounds[0])), 0.02);
  return Math.min(3, Math.max(0, Math.floor(-Math.log10(inwards || 1))));
}

function showPlace(place = [], places = 3) {
  const words = [...(state.epsg ? [`EPSG:${state.epsg}`] : []), ...place.map((value, k) => `${"xyz"[k]} ${digits(value, "m", places)}`)];
  $("place").replaceChildren(...words.map((text) => element("span", { textContent: text })));
}

async function begin() {
  const plain = new URLSearchParams(location.search).has("plain");
  document.documentElement.classList.toggle("plain", plain);
  $("open").append(iconButton("panel", "Show the panel (H)", () => showPanel(true)));
  const fit = () => showPanel(!plain && !NARROW.matches);
  NARROW.addEventListener("change", fit);
  fit();
  const told = await follow("state", () => ({}), NEWS_MS, (it) => {
    if (it.columns) return true;
    $("panel").replaceChildren(panel.progress, stop); // its only job has not started
    tellRun(it);
    if (it.failures[0]) say(it.failures[0].error, true);
    return false;
  });
  say(READING);
  picture.resize();
  picture.frame(told.box, told.arrays.corners, told.bounds); // the size of the sensor marks depends on the view
  drives = !told.live && told.sensors.some((sensor) => sensor.moves);
  chosen.rays = Boolean(told.live); // rays show the progress of a run, but hide the points of a result
  if (told.offline) chosen.budget = BUDGETS.at(-1); // all points are in the page
  if (told.results.length) chosen.color = "result";
  takeState(told);
  if (told.by_sweep) chosen.show = "sweep";
  if (!told.points && told.scene) chosen.scene = ["color", "object"].find((name) => told.scene.includes(name));
  const words = readLink();
  picture.opacity = chosen.opacity;
  buildPanel();
  picture.setTheme(document.documentElement.dataset.theme);
  buildSteps();
  buildTime();
  buildTools();
  picture.setTime(chosen.time);
  picture.resize(); // the player and the panel need space
  look(drives && !picture.isFlying ? "sensor" : "all");
  if (!$("time").hidden) tellTime();
  setClip(chosen.clip);
  showRays();
  picture.showObjects(objectLimits(), hiddenOf("object"));
  readCamera(words);
  showPath();
  showPicked();
  if (chosen.clipBox) showClipBox(true);
  setInterval(keepLink, 500);
  mouse();
  showPlace();
  addEventListener("keydown", keys);
  addEventListener("keyup", releaseKey);
  addEventListener("hashchange", () => location.reload()); // the user has entered another link
  document.addEventListener("visibilitychange", () => { if (document.hidden) setPlaying(false); });
  let before = performance.now();
  const frame = (now) => {
    if (playing) play(Math.min((now - before) / 1000, 0.25));
    before = now;
    picture.draw();
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
  if (state.live) {
    follow("news", () => ({}), NEWS_MS, news).catch((error) => {
      failed(error);
      panel.progress.replaceChildren(); // the run has ended
    });
  }
  refresh();
  if (state.growing) grow().catch(failed);
  showImages();
  await loadSurface();
}

begin().catch(failed);

// For tests and for the browser console.
Object.assign(window, { lidarpool: { picture, chosen, get state() { return state; }, get playing() { return playing; }, get steps() { return steps; } } });
