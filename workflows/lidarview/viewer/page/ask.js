// Requests data from the server or, in an exported page, from the page itself: JSON and arrays.

const TYPES = {
  float32: Float32Array, float64: Float64Array, uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, int32: Int32Array,
};

export async function ask(what, asked = {}, signal = undefined) {
  const query = new URLSearchParams(Object.entries(asked).filter(([, value]) => value !== undefined));
  if (inFile("state?")) return what === "points" ? pointsOf(asked) : what === "point" ? pointOf(asked.row) : held(`${what}?${query}`);
  return unpacked(await answerTo(what, `${what}?${query}`, signal));
}

// If the server is starting or busy, requests are repeated after these delays.
const PAUSES_MS = [250, 500, 1000, 0];

async function answerTo(what, address, signal) {
  for (const pause of PAUSES_MS) {
    let words = "";
    try {
      const answer = await fetch(address, { signal });
      if (answer.ok) return await answer.arrayBuffer();
      words = `The request "${what}" failed (${answer.status} ${answer.statusText}). See the terminal for the reason.`;
      if (answer.status < 500) throw new Error(words);
    } catch (error) {
      if (!(error instanceof TypeError)) throw error;
    }
    if (!pause) throw words ? new Error(words) : new TypeError("The server for this page has stopped.");
    await new Promise((done) => setTimeout(done, pause));
  }
}

function unpacked(bytes) {
  const length = new DataView(bytes).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, length)));
  const arrays = {};
  for (const [name, type, shape, at] of header.arrays) {
    arrays[name] = new TYPES[type](bytes, 4 + length + at, shape.reduce((a, b) => a * b, 1));
    arrays[name].shape = shape;
  }
  return { ...header, arrays };
}

// -- an exported page, which contains all answers, and a single answer with all points ------

const inFile = (question) => document.querySelector(`script[data-question="${question}"]`);
const known = new Map(); // {question: answer}

function held(question) {
  if (!known.has(question)) known.set(question, read(question));
  return known.get(question);
}

async function read(question) {
  const place = inFile(question);
  if (!place) throw new Error(`This file does not contain the answer to "${question}".`);
  const bytes = Uint8Array.from(atob(place.textContent), (letter) => letter.charCodeAt(0));
  return unpacked(await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
}

// Unpacks the values of a column from byte planes of zigzag differences; see `packing.py`.
const columns = new Map(); // {name: values}
function column(cloud, name) {
  if (columns.has(name)) return columns.get(name);
  const { base, step, fractions, logarithmic } = cloud.packed[name], bytes = cloud.arrays[name], { count } = cloud;
  const planes = count ? bytes.length / count : 0, isWhole = !fractions && Number.isInteger(base) && Number.isInteger(step);
  const values = isWhole ? new Float64Array(count) : new Float32Array(count);
  for (let k = 0, code = 0; k < count; k++) {
    let zigzag = 0;
    for (let plane = planes - 1; plane >= 0; plane--) zigzag = 256 * zigzag + bytes[plane * count + k];
    code += zigzag % 2 ? -(zigzag + 1) / 2 : zigzag / 2;
    const scaled = base + step * (fractions ? code - 1 : code);
    values[k] = !fractions ? scaled : !code ? NaN : logarithmic ? Math.exp(scaled) : scaled;
  }
  columns.set(name, values);
  return values;
}

// Returns a function that writes the color of a row to an array, 4 bytes per row.
function painter(cloud, name, limits) {
  const legend = cloud.legends[name], { arrays } = cloud, of = (part) => column(cloud, part);
  if (name === "rgb" && !cloud.packed.rgb) {
    const parts = ["red", "green", "blue"].map(of);
    return (row, to, at) => parts.forEach((part, k) => { to[at + k] = part[row]; });
  }
  if (name === "normals" && !cloud.packed.normals) {
    const parts = ["normal_x", "normal_y", "normal_z"].map(of);
    return (row, to, at) => parts.forEach((part, k) => { to[at + k] = Number.isNaN(part[row]) ? 128 : 127.5 * (1 + part[row]); });
  }
  const values = of(name), start = "xyz".includes(name) ? cloud.origin["xyz".indexOf(name)] : 0;
  if (!legend.limits) {
    const palette = new Map(Array.from(arrays[`${name} labels`], (value, k) => [value, 3 * k])), colors = arrays[`${name} palette`];
    return (row, to, at) => { const k = palette.get(values[row]); for (let part = 0; part < 3; part++) to[at + part] = colors[k + part]; };
  }
  const scale = arrays[`${name} scale`], logarithmic = legend.logarithmic && !(limits && limits[0] <= 0), as = logarithmic ? Math.log : (value) => value;
  const [low, high] = (limits ?? legend.limits).map(as), least = (limits ?? legend.limits)[0];
  return (row, to, at) => {
    const value = (values[row] + start) / legend.divisor;
    const share = (as(logarithmic ? Math.max(value, least) : value) - low) / (high - low || 1);
    const k = 3 * Math.min(255, Math.max(0, Math.floor(255 * share)));
    for (let part = 0; part < 3; part++) to[at + part] = Number.isNaN(value) ? 128 : scale[k + part];
  };
}

// Returns whether the values of a row are within the limits of a filter.
function testsOf(cloud, filter) {
  return filter.split(";").filter(Boolean).map((limit) => {
    const [text, low, high] = limit.split(","), name = text.replace(/^!/, ""), values = column(cloud, name);
    if (text !== name) return (k) => values[k] !== +low;
    const start = "xyz".includes(name) ? cloud.origin["xyz".indexOf(name)] : 0;
    return (k) => values[k] + start >= +low && values[k] + start <= +high;
  });
}

function chosenRows(cloud, filter, scans) {
  const tests = testsOf(cloud, filter), { count } = cloud;
  if (scans !== undefined && cloud.packed.scan) {
    const ranges = scans.split(",").filter(Boolean).map((range) => range.split("-").map(Number)), scan = column(cloud, "scan");
    tests.push((k) => ranges.some(([first, last]) => scan[k] >= first && scan[k] <= last));
  }
  const rows = new Uint32Array(count);
  let found = 0;
  for (let k = 0; k < count; k++) if (tests.every((test) => test(k))) rows[found++] = k;
  return rows.subarray(0, found);
}

async function pointsOf({ color, filter = "", scans, most, limits }) {
  const cloud = await held("cloud?"), all = chosenRows(cloud, filter, scans);
  const step = Math.max(1, Math.ceil(all.length / most)), rows = step === 1 ? all.slice() : all.filter((_, k) => k % step === 0);
  const positions = new Float32Array(3 * rows.length), colors = new Uint8Array(4 * rows.length).fill(255);
  const axes = ["x", "y", "z"].map((axis) => column(cloud, axis)), ends = limits?.split(",").map(Number), paint = painter(cloud, color, ends);
  rows.forEach((row, k) => {
    for (let axis = 0; axis < 3; axis++) positions[3 * k + axis] = axes[axis][row];
    paint(row, colors, 4 * k);
  });
  return { count: all.length, legend: legendWith(cloud.legends[color], ends), arrays: { positions, colors, rows } };
}

// Returns the legend of a color scale with limits that the user has set.
function legendWith(legend, limits) {
  if (!limits || !legend.limits) return legend;
  const [low, high] = limits, middle = legend.logarithmic && low > 0 ? Math.sqrt(low * high) : (low + high) / 2;
  return { ...legend, limits, marks: [low, middle, high].map((value) => `${+value.toPrecision(3)}`) };
}

async function pointOf(row) {
  const cloud = await held("cloud?"), { columns: listed } = await held("state?");
  const told = listed.filter(({ name }) => cloud.packed[name] && !"xyz".includes(name)).map(async ({ name, unit }) => {
    const { labels, unit: size } = await held(`column?name=${name}`), value = column(cloud, name)[row];
    const digits = size > 1 ? (value / size).toFixed(9) : Number.isInteger(value) ? value : +value.toPrecision(cloud.packed[name].fractions ? 4 : 6);
    return [name, labels?.find(([, label]) => label === value)?.[0] ?? `${digits} ${unit}`.trim()];
  });
  return { place: cloud.origin.map((start, axis) => column(cloud, "xyz"[axis])[row] + start), columns: await Promise.all(told) };
}
