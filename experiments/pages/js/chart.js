// Curves as SVG, with a line that follows the pointer or the arrow keys.

import { element, svg } from "./dom.js";

/**
 * @typedef {{ label: string, color: string, dash?: string, points: { x: number, y: number, low?: number, high?: number }[] }} Series
 * @typedef {{ series: Series[], title: string, xLabel: string, lines?: { label: string, y: number }[] }} Chart
 */

const HEIGHT = 280, LEFT = 48, RIGHT = 18, TOP = 12, BOTTOM = 38;

/** Units of the width of a chart: fewer on a narrow screen, so that its text stays readable. @type {(usual: number) => number} */
export const chartWidth = (usual) => (window.innerWidth < 600 ? Math.min(usual, 360) : usual);

/** Round numbers from low to high. @type {(low: number, high: number, num: number) => number[]} */
export function ticks(low, high, num) {
  const rough = (high - low) / num, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * ([1, 2, 5, 10].find((factor) => factor * power >= rough) ?? 10);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(Number((k * step).toPrecision(12)));
  return found;
}

/** @type {(low: number, high: number, from: number, to: number) => (value: number) => number} */
export const scale = (low, high, from, to) => (value) => from + ((value - low) / (high - low || 1)) * (to - from);

/** @param {Chart} chart @returns {HTMLElement} */
export function curves({ series, title, xLabel, lines = [] }) {
  const width = chartWidth(640);
  const all = series.flatMap(({ points }) => points);
  const heights = [...all.flatMap(({ y, low, high }) => [y, low ?? y, high ?? y]), ...lines.map(({ y }) => y)];
  const [bottom, top] = [Math.min(...heights), Math.max(...heights)], room = (top - bottom || 1) * 0.05;
  const [first, last] = [Math.min(...all.map(({ x }) => x)), Math.max(...all.map(({ x }) => x))];
  const x = scale(first, last, LEFT, width - RIGHT), y = scale(bottom - room, top + room, HEIGHT - BOTTOM, TOP);
  const path = (/** @type {[number, number][]} */ points) => points.map(([a, b]) => `${x(a).toFixed(1)},${y(b).toFixed(1)}`).join(" ");
  const said = element("p", { class: "said", "aria-live": "polite" });
  const ruler = svg("line", { y1: TOP, y2: HEIGHT - BOTTOM, class: "ruler", visibility: "hidden" });
  const dots = series.map(({ color }) => svg("circle", { r: 4, fill: color, visibility: "hidden" }));
  const xs = [...new Set(all.map((point) => point.x))].sort((a, b) => a - b);

  const show = (/** @type {number} */ at) => {
    ruler.setAttribute("x1", x(at));
    ruler.setAttribute("x2", x(at));
    ruler.setAttribute("visibility", "visible");
    const texts = series.map(({ label, points }, i) => {
      const point = points.find((one) => one.x === at);
      dots[i].setAttribute("visibility", point ? "visible" : "hidden");
      if (!point) return "";
      dots[i].setAttribute("cx", x(point.x));
      dots[i].setAttribute("cy", y(point.y));
      const spread = point.high === undefined ? "" : ` ± ${(point.high - point.y).toFixed(3)}`;
      return `${label} ${point.y.toFixed(3)}${spread}`;
    });
    said.textContent = `${xLabel} ${at}: ${texts.filter(Boolean).join("; ")}`;
  };
  let place = xs.length - 1;
  const drawing = svg(
    "svg",
    {
      viewBox: `0 0 ${width} ${HEIGHT}`, class: "chart", role: "img", tabindex: 0, "aria-label": `${title}; left and right arrow keys read values`,
      onpointermove: (/** @type {PointerEvent} */ event) => {
        const box = drawing.getBoundingClientRect(), at = ((event.clientX - box.left) / box.width) * width;
        place = xs.reduce((best, value, i) => (Math.abs(x(value) - at) < Math.abs(x(xs[best]) - at) ? i : best), 0);
        show(xs[place]);
      },
      onkeydown: (/** @type {KeyboardEvent} */ event) => {
        const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
        if (!by) return;
        event.preventDefault();
        event.stopPropagation();
        place = Math.min(Math.max(place + by, 0), xs.length - 1);
        show(xs[place]);
      },
    },
    ...ticks(bottom - room, top + room, 5).flatMap((value) => [
      svg("line", { x1: LEFT, x2: width - RIGHT, y1: y(value), y2: y(value), class: "grid" }),
      svg("text", { x: LEFT - 6, y: y(value) + 4, "text-anchor": "end" }, String(value)),
    ]),
    ...ticks(first, last, 6).map((value) => svg("text", { x: x(value), y: HEIGHT - BOTTOM + 16, "text-anchor": "middle" }, String(value))),
    svg("text", { x: (LEFT + width) / 2, y: HEIGHT - 4, "text-anchor": "middle" }, xLabel),
    ...lines.flatMap(({ label, y: at }) => [
      svg("line", { x1: LEFT, x2: width - RIGHT, y1: y(at), y2: y(at), class: "optimum" }),
      svg("text", { x: LEFT + 4, y: y(at) + (at > (top + bottom) / 2 ? 13 : -4) }, label),
    ]),
    ...series.filter(({ points }) => points.some(({ high }) => high !== undefined)).map(({ color, points }) =>
      svg("polygon", {
        points: `${path(points.map((p) => [p.x, p.high ?? p.y]))} ${path([...points].reverse().map((p) => [p.x, p.low ?? p.y]))}`,
        fill: color, opacity: 0.18,
      })),
    ...series.map(({ color, dash, points }) =>
      svg("polyline", { points: path(points.map((p) => [p.x, p.y])), fill: "none", stroke: color, "stroke-width": 2.2, "stroke-dasharray": dash ?? null })),
    ruler,
    ...dots,
  );
  said.textContent = "Point at the curves, or use the arrow keys on them.";
  return element("div", {}, drawing, said);
}
