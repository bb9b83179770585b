/**
 * Reads npz files: zip archives of numpy arrays.
 */

const END = 0x06054b50;
const ENTRY = 0x02014b50;

/** The tag of 64-bit sizes in an extra field. */
const LONG = 1;

const TYPES = {
  "<f4": Float32Array,
  "<f8": Float64Array,
  "<i4": Int32Array,
  "<u4": Uint32Array,
  "<i8": BigInt64Array,
  "<u8": BigUint64Array,
  "|b1": Uint8Array,
  "|u1": Uint8Array,
};

/**
 * Reads the named arrays of an npz file.
 *
 * @param {ArrayBuffer} file
 * @param {string[]} wanted The names of the arrays, without `.npy`.
 * @returns {Promise<Object<string, TypedArray>>} The arrays that the file has, by name, flat and in
 *   the order of C.
 * @throws {Error} If the file is damaged, or an array has another type of value or its columns first.
 */
export async function readNpz(file, wanted) {
  const view = new DataView(file);
  const arrays = {};
  for (const entry of entries(view)) {
    const name = entry.name.replace(/\.npy$/, "");
    if (wanted.includes(name)) arrays[name] = readNpy(await content(view, entry));
  }
  return arrays;
}

/** The values of an array as Float32Array, whatever numbers they are. */
export function floats(array) {
  return array instanceof Float32Array ? array : Float32Array.from(array, Number);
}

/** The entries of the central directory. */
function entries(view) {
  let end = view.byteLength - 22;
  while (end >= 0 && view.getUint32(end, true) !== END) end -= 1;
  if (end < 0) throw new Error("the archive has no directory");
  const found = [];
  let at = view.getUint32(end + 16, true);
  for (let left = view.getUint16(end + 10, true); left > 0; left -= 1) {
    if (view.getUint32(at, true) !== ENTRY) throw new Error("the archive's directory is damaged");
    const length = view.getUint16(at + 28, true);
    const extra = at + 46 + length;
    const after = extra + view.getUint16(at + 30, true);
    const long = longFields(view, at, extra, after);
    found.push({
      method: view.getUint16(at + 10, true),
      size: long.size,
      offset: long.offset,
      name: new TextDecoder().decode(new Uint8Array(view.buffer, at + 46, length)),
    });
    at = after + view.getUint16(at + 32, true);
  }
  return found;
}

/** The packed size and the offset of an entry, which may be in its extra field with 64 bits. */
function longFields(view, entry, extra, end) {
  let at = extra;
  while (at < end && view.getUint16(at, true) !== LONG) at += 4 + view.getUint16(at + 2, true);
  at += 4;
  const read = (field) => {
    const short = view.getUint32(entry + field, true);
    if (short !== 0xffffffff) return short;
    at += 8;
    return Number(view.getBigUint64(at - 8, true));
  };
  read(24);
  return { size: read(20), offset: read(42) };
}

/** The uncompressed bytes of an entry. */
async function content(view, entry) {
  const names = view.getUint16(entry.offset + 26, true) + view.getUint16(entry.offset + 28, true);
  const packed = new Uint8Array(view.buffer, entry.offset + 30 + names, entry.size);
  if (entry.method === 0) return packed.slice().buffer;
  if (entry.method !== 8) throw new Error(`${entry.name} has an unknown compression`);
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Response(unpacked).arrayBuffer();
}

/** The values of a numpy array. */
function readNpy(file) {
  const view = new DataView(file);
  const isLong = view.getUint8(6) > 1;
  const start = isLong ? 12 : 10;
  const length = isLong ? view.getUint32(8, true) : view.getUint16(8, true);
  const header = new TextDecoder().decode(new Uint8Array(file, start, length));
  const type = /'descr': *'([^']+)'/.exec(header)?.[1];
  const values = TYPES[type];
  if (!values) throw new Error(`an array has the type ${type}`);
  const isTable = /'shape': *\([^)]*\d *, *\d/.test(header);
  if (isTable && /'fortran_order': *True/.test(header)) throw new Error("an array has its columns first (Fortran order)");
  return new values(file.slice(start + length));
}
