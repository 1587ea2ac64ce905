// Asks the server of this page, or an exported page itself: an answer is JSON, with arrays beside it.

const TYPES = {
  float32: Float32Array, float64: Float64Array, uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, int32: Int32Array,
};

export async function ask(what, asked = {}, signal = undefined) {
  const query = new URLSearchParams(Object.entries(asked).filter(([, value]) => value !== undefined));
  if (inFile("state?")) return what === "points" ? pointsOf(asked) : what === "point" ? pointOf(asked.row) : held(`${what}?${query}`);
  const answer = await fetch(`${what}?${query}`, { signal });
  if (!answer.ok) throw new Error(`${what}: ${answer.status}`);
  return unpacked(await answer.arrayBuffer());
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

// -- an exported page: it holds answers, and of the points one for all questions -----------

const inFile = (question) => document.querySelector(`script[data-question="${question}"]`);
const known = new Map(); // {question: answer}

function held(question) {
  if (!known.has(question)) known.set(question, read(question));
  return known.get(question);
}

async function read(question) {
  const place = inFile(question);
  if (!place) throw new Error(`${question}: not in this file`);
  const bytes = Uint8Array.from(atob(place.textContent), (letter) => letter.charCodeAt(0));
  return unpacked(await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer());
}

async function pointsOf({ colour, filter = "", scans, most }) {
  const { arrays, origin, legends } = await held("cloud?");
  const ranges = scans?.split(",").filter(Boolean).map((range) => range.split("-").map(Number));
  const limits = filter.split(";").filter(Boolean).map((limit) => limit.split(","));
  const tests = limits.map(([name, low, high]) => {
    const axis = "xyz".indexOf(name), values = arrays[name];
    return axis < 0 ? (k) => values[k] >= +low && values[k] <= +high : (k) => {
      const value = arrays.positions[3 * k + axis] + origin[axis];
      return value >= +low && value <= +high;
    };
  });
  if (ranges && arrays.scan) tests.push((k) => ranges.some(([first, last]) => arrays.scan[k] >= first && arrays.scan[k] <= last));
  const found = [];
  for (let k = 0; k < arrays.positions.shape[0]; k++) if (tests.every((test) => test(k))) found.push(k);
  const step = Math.ceil(found.length / most), rows = Uint32Array.from(found.filter((_, k) => k % step === 0));
  const positions = Float32Array.from({ length: 3 * rows.length }, (_, k) => arrays.positions[3 * rows[(k / 3) | 0] + (k % 3)]);
  const shades = arrays[`${colour} shades`], palette = arrays[`${colour} palette`];
  const colours = new Uint8Array(Uint32Array.from(rows, (k) => palette[shades[k]]).buffer);
  return { count: found.length, legend: legends[colour], arrays: { positions, colours, rows } };
}

async function pointOf(row) {
  const { arrays, origin } = await held("cloud?"), { columns } = await held("state?");
  const told = columns.filter(({ name }) => arrays[name]).map(async ({ name, unit }) => {
    const { labels, unit: size } = await held(`column?name=${name}`), value = arrays[name][row];
    const digits = size > 1 ? (value / size).toFixed(9) : Number.isInteger(value) ? value : +value.toPrecision(6);
    return [name, labels?.find(([, label]) => label === value)?.[0] ?? `${digits} ${unit}`.trim()];
  });
  return { place: origin.map((start, axis) => arrays.positions[3 * row + axis] + start), columns: await Promise.all(told) };
}
