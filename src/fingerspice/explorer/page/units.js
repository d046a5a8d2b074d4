// Numbers in SPICE's notation, and quantities with a prefix.

const POWERS = { t: 12, g: 9, meg: 6, k: 3, m: -3, u: -6, "µ": -6, n: -9, p: -12, f: -15 };
const NUMBER = /^([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)(meg|[tgkmunpfµ])?[a-z]*$/i;

/** The value of a text such as 3.5u, 0.2meg or, with a unit, 3.5um; null where it is none. */
export function parse(text) {
  const word = text.trim();
  if (/^inf$/i.test(word)) return Infinity;
  const found = NUMBER.exec(word);
  if (!found) return null;
  if (!found[2]) return Number(found[1]);
  // The digits are joined with the exponent, so that 3.5u is the double nearest to 3.5e-6.
  const [digits, exponent] = found[1].toLowerCase().split("e");
  return Number(`${digits}e${Number(exponent || 0) + POWERS[found[2].toLowerCase()]}`);
}

const PREFIXED = ["m", "V", "A", "ohm", "ohm m", "F", "Hz", "s", "V/m"];
const SUFFIXES = [[1e12, "t"], [1e9, "g"], [1e6, "meg"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "u"], [1e-9, "n"], [1e-12, "p"], [1e-15, "f"]];

/** A number for a text field: in SPICE's notation where its unit takes a prefix. */
export function spice(value, unit, digits = 4) {
  if (value === null || !Number.isFinite(value)) return "inf";
  const plain = (x) => String(Number(x.toPrecision(digits)));
  if (value === 0 || !PREFIXED.includes(unit)) return plain(value);
  const rounded = Math.abs(Number(value.toPrecision(digits)));
  const [size, suffix] = SUFFIXES.find(([s]) => rounded >= s * 0.9999999) || SUFFIXES[SUFFIXES.length - 1];
  return plain(value / size) + suffix;
}

const PREFIXES = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "µ"], [1e-9, "n"], [1e-12, "p"]];

/** Factor and name of the unit in which values up to `largest` are easily read. */
export function scale(largest, unit) {
  if (unit === "m^2") return [1e6, "mm²"];
  if (unit === "1" || unit === "") return [1, ""];
  if (!(largest > 0)) return [1, unit];
  const [size, prefix] = PREFIXES.find(([s]) => largest >= s) || PREFIXES[PREFIXES.length - 1];
  return [1 / size, prefix + unit];
}

/** A quantity with its unit, such as 3.5 µm. */
export function quantity(value, unit, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const [factor, name] = scale(Math.abs(value), unit);
  return `${Number((value * factor).toPrecision(digits))} ${name}`.trim();
}

/** The parts of an answer of the server, each as soon as it is there: two sizes, JSON, and arrays that are not copied. */
export class Parts {
  constructor(response) {
    this.reader = response.body.getReader();
    this.piece = new Uint8Array(0);
  }

  /** So many bytes in a buffer of their own; null where the answer ends before them. */
  async bytes(count) {
    const out = new Uint8Array(count);
    for (let at = 0; at < count; ) {
      if (!this.piece.length) {
        const { done, value } = await this.reader.read();
        if (done) return null;
        this.piece = value;
      }
      const some = this.piece.subarray(0, count - at);
      out.set(some, at);
      at += some.length;
      this.piece = this.piece.subarray(some.length);
    }
    return out.buffer;
  }

  /** The next part; an empty one after the last. */
  async next() {
    const sizes = await this.bytes(8);
    if (!sizes) return {};
    const [length, doubles] = [0, 4].map((at) => new DataView(sizes).getUint32(at, true));
    const buffer = await this.bytes(length + 8 * doubles);
    if (!buffer) throw new Error("its answer breaks off");
    const text = new TextDecoder().decode(new Uint8Array(buffer, 0, length));
    return JSON.parse(text, (_, x) => (x && x.f64 ? new Float64Array(buffer, length + 8 * x.f64[0], x.f64[1]) : x));
  }
}

/** An array of numbers for the server. */
export function encoded(values) {
  const bytes = new Uint8Array(Float64Array.from(values).buffer);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}
