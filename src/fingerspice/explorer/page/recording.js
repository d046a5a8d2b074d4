// Files dropped on the page: recordings (WAV) and tables (CSV) as the server takes them.

import { encoded } from "./units.js";

const LARGEST = 200000;

/** The recording of a file, or an error that says what is wrong with it. */
export async function read(file) {
  const isWav = /\.wav$/i.test(file.name);
  if (!isWav && !/\.(csv|txt)$/i.test(file.name)) throw new Error(`${file.name} is neither a .wav nor a .csv file`);
  const found = isWav ? wav(new DataView(await file.arrayBuffer()), file.name) : table(await file.text(), file.name);
  if (found.values.length > LARGEST) {
    throw new Error(`${file.name} has ${found.values.length} samples; allowed here: at most ${LARGEST}. fingerspice run takes longer ones`);
  }
  const { values, times, rate } = found;
  return { name: file.name, values: encoded(values), ...(times ? { times: encoded(times) } : { rate }) };
}

/** The first channel of a WAV file of integers or floats. */
function wav(data, name) {
  const word = (at) => String.fromCharCode(...[0, 1, 2, 3].map((i) => data.getUint8(at + i)));
  if (data.byteLength < 44 || word(0) !== "RIFF" || word(8) !== "WAVE") throw new Error(`${name} is no WAV file`);
  let format = null;
  for (let at = 12; at + 8 <= data.byteLength; ) {
    const [kind, size] = [word(at), data.getUint32(at + 4, true)];
    if (kind === "fmt ") {
      const tag = data.getUint16(at + 8, true);
      format = { tag: tag === 0xfffe ? data.getUint16(at + 32, true) : tag, channels: data.getUint16(at + 10, true),
        rate: data.getUint32(at + 12, true), step: data.getUint16(at + 20, true), bits: data.getUint16(at + 22, true) };
    }
    if (kind === "data" && format) return { rate: format.rate, values: samples(data, at + 8, Math.min(size, data.byteLength - at - 8), format, name) };
    at += 8 + size + (size % 2);
  }
  throw new Error(`${name} has no samples`);
}

function samples(data, start, size, { tag, step, bits }, name) {
  const readers = {
    "1/8": (at) => (data.getUint8(at) - 128) / 128,
    "1/16": (at) => data.getInt16(at, true) / 2 ** 15,
    "1/24": (at) => (data.getInt8(at + 2) * 65536 + data.getUint16(at, true)) / 2 ** 23,
    "1/32": (at) => data.getInt32(at, true) / 2 ** 31,
    "3/32": (at) => data.getFloat32(at, true),
    "3/64": (at) => data.getFloat64(at, true),
  };
  const one = readers[`${tag}/${bits}`];
  if (!one || !step) throw new Error(`${name} is compressed, or of ${bits} bits; allowed: integers of 8 to 32 bits, or floats`);
  return Array.from({ length: Math.floor(size / step) }, (_, i) => one(start + i * step));
}

/** Two columns of a table, time (s) and value (V), after a head if there is one. */
function table(text, name) {
  const rows = text.split(/\r?\n/).map((line) => line.trim()).filter((line) => line && !line.startsWith("#"));
  const split = rows.map((line) => line.split(/[,;\t ]+/));
  const first = split.length && split[0].every((word) => Number.isFinite(Number(word))) ? 0 : 1;
  const points = split.slice(first).map((words) => words.map(Number));
  const wrong = points.findIndex((p) => p.length !== 2 || !p.every(Number.isFinite));
  if (points.length < 2) throw new Error(`${name} has fewer than two rows of numbers`);
  if (wrong >= 0) throw new Error(`${name}, row ${wrong + first + 1}: allowed: two numbers, time in s and voltage in V`);
  return { times: points.map((p) => p[0]), values: points.map((p) => p[1]) };
}
