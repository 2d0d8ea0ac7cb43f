// Arrays that experiments/pages/packing.py wrote, and small helpers for them.

/**
 * @typedef {{ arrays: { name: string, type: string, shape: number[] }[], bytes: string }} Packed
 * @typedef {{ data: any, shape: number[] }} Shaped
 */

/** Arrays by name. @type {(packed: Packed) => Promise<Record<string, Shaped>>} */
export async function unpack(packed) {
  const text = atob(packed.bytes);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(stream).arrayBuffer();
  /** @type {Record<string, any>} */
  const kinds = { float32: Float32Array, float16: Uint16Array, uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array };
  /** @type {Record<string, Shaped>} */
  const arrays = {};
  let at = 0;
  for (const { name, type, shape } of packed.arrays) {
    const raw = new kinds[type](buffer.slice(at, at + product(shape) * kinds[type].BYTES_PER_ELEMENT));
    at += raw.byteLength;
    arrays[name] = { data: type === "float16" ? fromHalves(raw) : raw, shape };
  }
  return arrays;
}

/** @type {(numbers: number[]) => number} */
export const product = (numbers) => numbers.reduce((a, b) => a * b, 1);

/** Numbers in half precision as floats. @type {(halves: Uint16Array) => Float32Array} */
export function fromHalves(halves) {
  return Float32Array.from(halves, (half) => {
    const sign = half >> 15 ? -1 : 1, exponent = (half >> 10) & 31, fraction = half & 1023;
    return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -24 * fraction);
  });
}

/** The numbers from 0 to n - 1. @type {(n: number) => number[]} */
export const range = (n) => Array.from({ length: n }, (_, i) => i);

/** @type {(numbers: ArrayLike<number>) => number} */
export const mean = (numbers) => Array.from(numbers).reduce((a, b) => a + b, 0) / numbers.length;
