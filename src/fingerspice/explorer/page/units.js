// Numbers in SPICE's notation, and quantities with a prefix.

const SCALES = { t: 1e12, g: 1e9, meg: 1e6, k: 1e3, m: 1e-3, u: 1e-6, "µ": 1e-6, n: 1e-9, p: 1e-12, f: 1e-15 };
const NUMBER = /^([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)(meg|[tgkmunpfµ])?$/i;

/** The value of a text such as 3.5u or 0.2meg; null where it is none. */
export function parse(text) {
  const word = text.trim();
  if (/^inf$/i.test(word)) return Infinity;
  const found = NUMBER.exec(word);
  if (!found) return null;
  if (!found[2]) return Number(found[1]);
  // The digits are joined with the exponent, so that 3.5u is the double nearest to 3.5e-6.
  const [digits, exponent] = found[1].toLowerCase().split("e");
  const power = Math.round(Math.log10(SCALES[found[2].toLowerCase()]));
  return Number(`${digits}e${Number(exponent || 0) + power}`);
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

/** The numbers of an array from the server. */
export function numbers(given) {
  const text = atob(given.f64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
  return new Float64Array(bytes.buffer);
}

/** An array of numbers for the server. */
export function encoded(values) {
  const bytes = new Uint8Array(Float64Array.from(values).buffer);
  let text = "";
  for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(text);
}
