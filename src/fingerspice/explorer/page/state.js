// What the page shows, and its form as the part of the address after the #.

/** Keys of a request other than the deck and the values, with their kinds. */
const OPTIONS = { source: "text", charge_law: "text", area: "text", skin: "text", rtol: "number", periods: "number", last: "number", sets: "text" };
const VALUE = "set.";
/** Name of the scene for which the page was opened. */
export const OWN = "own";

/** A state: a scene's name or a deck, values by path (as text), and options. */
export function blank(scene) {
  return { scene, deck: null, set: {}, options: { last: "2" } };
}

/** The state of an example: what its request asks for is part of the state. */
export function ofExample(example) {
  const state = blank(example.name);
  for (const [key, value] of Object.entries(example.request)) {
    if (key in OPTIONS) state.options[key] = String(value);
  }
  Object.assign(state.set, example.request.overrides);
  return state;
}

/** A state with the values and the source of its scene, and with the run as it is. */
export function reset(state, examples) {
  const example = examples.find((e) => e.name === state.scene);
  const first = state.deck === null ? ofExample(example) : blank(state.scene);
  const kept = { ...state.options };
  for (const key of ["source", "sets"]) delete kept[key];
  const { source, sets } = first.options;
  return { ...state, set: first.set, options: { ...kept, ...(source && { source }), ...(sets && { sets }) } };
}

/** The address of a state; the deck of the user's own circuit stands in it, since another explorer has another one. */
export function toHash(state, examples) {
  const parts = new URLSearchParams();
  const own = state.scene === OWN ? examples.find((e) => e.name === OWN) : null;
  if (state.deck !== null) parts.set("deck", state.deck);
  else if (own) parts.set("deck", own.request.deck);
  else parts.set("scene", state.scene);
  for (const [path, text] of Object.entries(state.set)) parts.set(VALUE + path, text);
  for (const [key, value] of Object.entries(state.options)) parts.set(key, value);
  return `#${parts}`;
}

/** The state of an address, and sentences about names in it that mean nothing. */
export function fromHash(hash, examples) {
  const parts = new URLSearchParams(hash.replace(/^[^#]*#/, ""));
  const unknown = [];
  const name = parts.get("scene");
  const example = examples.find((e) => e.name === name);
  if (name !== null && !example) unknown.push(`unknown scene "${name}" in the link; the first scene is shown`);
  const state = blank((example || examples[0]).name);
  if (parts.has("deck")) {
    const known = examples.find((e) => e.request.deck === parts.get("deck"));
    if (known) state.scene = known.name;
    else state.deck = parts.get("deck");
  }
  state.options = {};
  for (const [key, value] of parts) {
    if (key === "scene" || key === "deck") continue;
    if (key.startsWith(VALUE)) state.set[key.slice(VALUE.length)] = value;
    else if (key in OPTIONS) state.options[key] = value;
    else unknown.push(`unknown name "${key}" in the link, which is left out`);
  }
  const own = state.scene === OWN ? examples.find((e) => e.name === OWN).request : {};
  for (const path of Object.keys(own.overrides || {})) {
    if (!(path in state.set)) unknown.push(`${path} was changed before this page was opened, and the link says nothing of it: it stays so`);
  }
  return [state, unknown];
}

/** The request for a state. */
export function request(state, examples) {
  const deck = state.deck !== null ? state.deck : examples.find((e) => e.name === state.scene).request.deck;
  const asked = { deck, overrides: { ...state.set } };
  for (const [key, kind] of Object.entries(OPTIONS)) {
    const value = state.options[key];
    if (value === undefined || value === "") continue;
    // A number that is none is sent as it is: the server says what is allowed.
    asked[key] = kind === "number" && Number.isFinite(Number(value)) ? Number(value) : value;
  }
  return asked;
}
