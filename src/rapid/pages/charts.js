// Line charts, drawn as SVG: point at a curve to read it, click a name to hide it, arrow keys read values.

const ticks = (low, high, count) => {
  const raw = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= raw);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) found.push(i * step);
  const digits = [0, 1, 2, 3, 4].find((d) => Math.abs(step * 10 ** d - Math.round(step * 10 ** d)) < 1e-9) ?? 5;
  return found.map((value) => [value, step >= 1e3 ? `${value / 1e3}k` : value.toFixed(digits)]);
};

function lineChart(spec) {
  const hidden = new Set();
  const figure = element("figure", { class: "chart" }, element("figcaption", {}, spec.title));
  const svg = shape("svg", { tabindex: 0, role: "img", "aria-label": `${spec.title}: ${spec.y} over ${spec.x}. Arrow keys read values.` });
  const legend = element("div", { class: "legend" });
  const outputs = spec.series.map((line, i) => {
    const output = element("output");
    const swatch = element("i", { class: "swatch" });
    swatch.style.background = `var(${LINES[i % LINES.length]})`;
    const button = element("button", { type: "button", "aria-pressed": "true" }, swatch, line.name, output);
    button.addEventListener("click", () => {
      hidden.has(i) ? hidden.delete(i) : hidden.add(i);
      button.setAttribute("aria-pressed", String(!hidden.has(i)));
      draw();
    });
    legend.append(button);
    return output;
  });
  figure.append(svg, legend);
  const times = [...new Set(spec.series.flatMap((line) => line.points.map((p) => p[0])))].sort((a, b) => a - b);
  let at = null, xScale = null, cursor = null, dots = [];

  function draw() {
    const width = Math.max(svg.clientWidth, 240), height = 230;
    const box = { left: 46, right: width - 14, top: 24, bottom: height - 36 };
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    svg.setAttribute("height", height);
    svg.replaceChildren();
    const shown = spec.series.filter((_, i) => !hidden.has(i));
    const ys = shown.flatMap((line) => line.points.map((p) => p[1])).concat(spec.marks.map((m) => m.y));
    let low = Math.min(...ys, spec.zero ? 0 : Infinity), high = Math.max(...ys, spec.zero ? 0 : -Infinity);
    if (!ys.length) [low, high] = [0, 1];
    if (high - low < 1e-12) high = low + 1;
    high += (high - low) * 0.06;
    const first = times[0], last = times.at(-1) > first ? times.at(-1) : first + 1;
    xScale = (x) => box.left + ((x - first) / (last - first)) * (box.right - box.left);
    const yScale = (y) => box.bottom - ((y - low) / (high - low)) * (box.bottom - box.top);
    for (const [y, label] of ticks(low, high, 5)) {
      svg.append(shape("line", { class: "grid", x1: box.left, x2: box.right, y1: yScale(y), y2: yScale(y) }));
      svg.append(shape("text", { x: box.left - 8, y: yScale(y) + 4, "text-anchor": "end" }, label));
    }
    for (const [x, label] of ticks(first, last, Math.max(2, Math.floor(width / 110)))) {
      svg.append(shape("text", { x: xScale(x), y: box.bottom + 16, "text-anchor": "middle" }, label));
    }
    svg.append(shape("text", { x: box.right, y: height - 4, "text-anchor": "end" }, spec.x));
    svg.append(shape("text", { x: 0, y: 10 }, spec.y));
    for (const mark of spec.marks) {
      svg.append(shape("line", { class: "mark", x1: box.left, x2: box.right, y1: yScale(mark.y), y2: yScale(mark.y) }));
    }
    spec.series.forEach((line, i) => {
      if (hidden.has(i)) return;
      const stroke = `var(${LINES[i % LINES.length]})`;
      const path = line.points.map((p, n) => `${n ? "L" : "M"}${xScale(p[0]).toFixed(1)} ${yScale(p[1]).toFixed(1)}`).join("");
      svg.append(shape("path", { class: "line", d: path, style: `stroke:${stroke}` }));
      if (line.points.length <= 30) {
        for (const p of line.points) svg.append(shape("circle", { cx: xScale(p[0]), cy: yScale(p[1]), r: 2.4, style: `fill:${stroke}` }));
      }
    });
    for (const mark of spec.marks) {
      svg.append(shape("text", { class: "mark-label", x: box.right, y: yScale(mark.y) - 5, "text-anchor": "end" }, mark.label));
    }
    cursor = shape("g");
    svg.append(cursor);
    dots = { box, yScale };
    if (at !== null) point(at);
  }

  const near = (points, x) => points.reduce((best, p) => (Math.abs(p[0] - x) < Math.abs(best[0] - x) ? p : best));
  function point(x) {
    at = x;
    cursor.replaceChildren();
    if (x === null) return outputs.forEach((output) => (output.value = ""));
    const { box, yScale } = dots;
    const px = xScale(x);
    cursor.append(shape("line", { class: "cursor", x1: px, x2: px, y1: box.top, y2: box.bottom }));
    const right = px > (box.left + box.right) / 2;
    cursor.append(shape("text", { x: px + (right ? -6 : 6), y: box.top - 4, "text-anchor": right ? "end" : "start" }, `${spec.x} ${Math.round(x)}`));
    spec.series.forEach((line, i) => {
      const p = near(line.points, x);
      outputs[i].value = hidden.has(i) ? "" : short(p[1]);
      if (!hidden.has(i)) cursor.append(shape("circle", { cx: xScale(p[0]), cy: yScale(p[1]), r: 4, style: `fill:var(${LINES[i % LINES.length]})` }));
    });
  }
  svg.addEventListener("pointermove", (event) => {
    const px = event.clientX - svg.getBoundingClientRect().left;
    point(times.reduce((best, t) => (Math.abs(xScale(t) - px) < Math.abs(xScale(best) - px) ? t : best)));
  });
  svg.addEventListener("pointerleave", () => point(null));
  svg.addEventListener("blur", () => point(null));
  svg.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    const i = at === null ? (step > 0 ? -1 : times.length) : times.indexOf(at);
    point(times[Math.min(Math.max(i + step, 0), times.length - 1)]);
  });
  new ResizeObserver(draw).observe(figure);
  return figure;
}
