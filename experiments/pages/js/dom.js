// Elements of the page. Texts from files enter by textContent, never as markup.

/** @typedef {string | Node | null | undefined | false} Child */

/**
 * A new element with attributes, listeners (names that begin with "on") and children.
 * @param {string} tag @param {Record<string, any>} [attributes] @param {...Child} children
 * @returns {any}
 */
export function element(tag, attributes = {}, ...children) {
  return furnish(document.createElement(tag), attributes, children);
}

/** The same in SVG. @param {string} tag @param {Record<string, any>} [attributes] @param {...Child} children @returns {any} */
export function svg(tag, attributes = {}, ...children) {
  return furnish(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

/** @param {Element} made @param {Record<string, any>} attributes @param {Child[]} children */
function furnish(made, attributes, children) {
  for (const [name, value] of Object.entries(attributes))
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== null && value !== false) made.setAttribute(name, value === true ? "" : value);
  made.append(...children.filter((child) => child || child === "").map((child) => /** @type {string | Node} */ (child)));
  return made;
}

/** The element of an id in the page's own markup. @param {string} id @returns {any} */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element ${id}`);
  return found;
}

/** Say that the page is complete and can be used, to tests and to measurements of how long this took. */
export function sayReady() {
  document.body.dataset.ready = "yes";
  performance.mark("ready");
}

/** Put children in the place of what an element holds. @param {Element} parent @param {...Child} children */
export function fill(parent, ...children) {
  parent.replaceChildren(...children.filter(Boolean).map((child) => /** @type {string | Node} */ (child)));
}

/**
 * The goals of a prompt, numbered, with a mark on those far from all goals of the training.
 * @param {Element} parent @param {string[]} names @param {boolean[]} far
 */
export function showPrompt(parent, names, far) {
  fill(parent, ...names.map((name, i) => {
    const kind = ["chip", i === names.length - 1 && "last", far[i] && "far"].filter(Boolean).join(" ");
    const title = far[i] ? "far from all goals that the policy was trained on" : null;
    return element("span", { class: kind, title }, element("b", {}, String(i + 1)), name, far[i] && element("em", {}, "far"));
  }));
}

/** The colors of the drawing in the page's present scheme. @returns {Colors} */
export function colorsOf() {
  const style = getComputedStyle(document.documentElement);
  const names = ["ink", "faint", "paper", "free", "wall", "line", "hidden", "visit", "sight", "agent", "prompt", "target",
    "start", "focus", "markEdge", "onBox", "onDisc"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

const DARK = "(prefers-color-scheme: dark)";

/** Whether the page's present scheme is dark. */
export const isDark = () => matchMedia(DARK).matches;

/** Call when the scheme changes between light and dark. @param {() => void} draw */
export function onScheme(draw) {
  matchMedia(DARK).addEventListener("change", draw);
}

/**
 * Draw a scene of a world on a canvas, as sharp as the screen allows.
 * @param {HTMLCanvasElement} canvas @param {WorldDrawing} world @param {any} facts @param {Scene} scene
 */
export function drawScene(canvas, world, facts, scene) {
  const context = canvas.getContext("2d");
  const [width, height] = world.size(facts), margin = 0.35;
  const pixels = Math.max(1, Math.round(canvas.clientWidth * (window.devicePixelRatio || 1)));
  if (!context || !canvas.clientWidth) return;
  canvas.width = pixels;
  canvas.height = Math.round((pixels * (height + 2 * margin)) / (width + 2 * margin));
  const unit = pixels / (width + 2 * margin);
  context.setTransform(unit, 0, 0, unit, margin * unit, margin * unit);
  world.draw(context, facts, scene, colorsOf());
  canvas.setAttribute("aria-label", world.tell(facts, scene));
}

/** The spot under a pointer. @param {HTMLCanvasElement} canvas @param {WorldPage} world @param {any} facts @param {PointerEvent} event @returns {Spot | null} */
export function spotAt(canvas, world, facts, event) {
  const box = canvas.getBoundingClientRect(), [width, height] = world.size(facts), margin = 0.35;
  const column = Math.floor(((event.clientX - box.left) / box.width) * (width + 2 * margin) - margin);
  const row = Math.floor(((event.clientY - box.top) / box.height) * (height + 2 * margin) - margin);
  const [rows, columns] = world.spots(facts);
  return row >= 0 && column >= 0 && row < rows && column < columns ? { row, column } : null;
}

/** What the marks of a world mean, with their colors. @param {WorldDrawing["legend"]} legend @param {any} facts */
export function legendOf(legend, facts) {
  return (typeof legend === "function" ? legend(facts) : legend).map(([color, text]) => {
    const swatch = element("span", { class: "swatch", "aria-hidden": "true" });
    swatch.style.background = color.startsWith("#") ? color : `var(--${color})`;
    return element("span", { class: "entry" }, swatch, text);
  });
}
