// Asks the server of this page: an answer is JSON, with arrays beside it.

const TYPES = {
  float32: Float32Array, float64: Float64Array, uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, int32: Int32Array,
};

export async function ask(what, asked = {}, signal = undefined) {
  const query = new URLSearchParams(Object.entries(asked).filter(([, value]) => value !== undefined));
  const answer = await fetch(`${what}?${query}`, { signal });
  if (!answer.ok) throw new Error(`${what}: ${answer.status}`);
  const bytes = await answer.arrayBuffer();
  const length = new DataView(bytes).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, length)));
  const arrays = {};
  for (const [name, type, shape, at] of header.arrays) {
    arrays[name] = new TYPES[type](bytes, 4 + length + at, shape.reduce((a, b) => a * b, 1));
    arrays[name].shape = shape;
  }
  return { ...header, arrays };
}
