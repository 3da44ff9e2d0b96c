// Small helpers that all scripts of a page share. A page's script is these files one after another, in one function.

const SVG = "http://www.w3.org/2000/svg";
const LINES = ["--one", "--two", "--three", "--four", "--five", "--six"];
const ACTIONS = ["--left", "--idle", "--right", "--faster", "--slower"];

// All text goes through textContent or setAttribute: nothing from the data is ever read as HTML.
const build = (node, attributes, children) => {
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
};
const element = (name, attributes = {}, ...children) => build(document.createElement(name), attributes, children);
const shape = (name, attributes = {}, ...children) => build(document.createElementNS(SVG, name), attributes, children);
const button = (words, attributes, action) => {
  const node = element("button", { type: "button", ...attributes }, words);
  node.addEventListener("click", action);
  return node;
};
const chooser = (label, pairs, attributes = {}) => {
  const node = element("select", { "aria-label": label, ...attributes });
  for (const [value, words] of pairs) node.append(element("option", { value }, words));
  return node;
};

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const lerp = (a, b, u) => a + (b - a) * u;
const short = (value) => {
  const size = Math.abs(value);
  if (size >= 1e4) return `${+(value / 1e3).toPrecision(3)}k`;
  return size >= 100 ? value.toFixed(0) : size >= 10 ? value.toFixed(1) : String(+value.toFixed(3));
};
const signed = (value, digits = 0) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)}`;

// Colours are those of the style sheet, so that light, dark and print are decided in one place. Canvases ask for them
// many times a frame, so they are kept until the scheme changes.
let colors = new Map();
const color = (name) => {
  if (!colors.has(name)) colors.set(name, getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  return colors.get(name);
};
const onScheme = [];
const repaint = () => {
  colors = new Map();
  for (const call of onScheme) call();
};
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);
matchMedia("print").addEventListener("change", repaint);

const channels = (name) => [1, 3, 5].map((i) => parseInt(color(name).slice(i, i + 2), 16));
// The colour at share `u` of the way from one named colour to another.
const blend = (from, to, u) => {
  const [a, b] = [channels(from), channels(to)];
  return `rgb(${a.map((value, i) => Math.round(lerp(value, b[i], clamp(u, 0, 1)))).join(" ")})`;
};
