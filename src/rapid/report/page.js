"use strict";
(() => {
  const data = JSON.parse(document.getElementById("payload").textContent);
  const LINES = ["--one", "--two", "--three", "--four", "--five", "--six"];
  const ACTIONS = ["--left", "--idle", "--right", "--faster", "--slower"];
  const SVG = "http://www.w3.org/2000/svg";
  const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  // All text goes through textContent or setAttribute: nothing from the data is ever read as HTML.
  const element = (name, attributes = {}, ...children) => {
    const node = document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...children);
    return node;
  };
  const shape = (name, attributes = {}, text) => {
    const node = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (text !== undefined) node.textContent = text;
    return node;
  };
  const short = (value) => {
    const size = Math.abs(value);
    if (size >= 1e4) return `${+(value / 1e3).toPrecision(3)}k`;
    return size >= 100 ? value.toFixed(0) : size >= 10 ? value.toFixed(1) : String(+value.toFixed(3));
  };

  // Tables: a click on a head sorts by the values behind the cells; empty cells stay last.
  for (const table of document.querySelectorAll("table.sortable")) {
    const body = table.tBodies[0];
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) => {
      const button = head.querySelector("button");
      if (!button) return;
      button.addEventListener("click", () => {
        const text = head.dataset.sort === "text";
        const was = head.getAttribute("aria-sort");
        const up = was ? was === "descending" : text;
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", up ? "ascending" : "descending");
        const key = (row) => row.cells[column].dataset.value;
        const order = (a, b) => {
          const [x, y] = [key(a), key(b)];
          if (x === undefined || y === undefined) return (x === undefined) - (y === undefined);
          return (text ? x.localeCompare(y) : x - y) * (up ? 1 : -1);
        };
        body.append(...[...body.rows].sort(order));
      });
    });
  }

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

  const place = document.getElementById("curves-canvas");
  if (place) {
    const main = element("div", { class: "charts" });
    const rest = element("div", { class: "charts" });
    for (const spec of data.charts) (spec.detail ? rest : main).append(lineChart(spec));
    place.append(main);
    if (rest.childElementCount) place.append(element("details", {}, element("summary", {}, "Terms of the losses"), rest));
  }

  function player(root) {
    const view = { canvas: element("canvas", { role: "img", "aria-label": "The road from above" }) };
    const play = element("button", { type: "button", class: "play" }, "Play");
    const back = element("button", { type: "button", "aria-label": "one decision back" }, "‹");
    const on = element("button", { type: "button", "aria-label": "one decision on" }, "›");
    const pace = element("select", { "aria-label": "pace" });
    for (const rate of [0.5, 1, 2, 4]) pace.append(element("option", { value: rate }, `${rate} × real time`));
    pace.value = "2";
    const choose = element("select", { class: "episode", "aria-label": "episode" });
    data.episodes.forEach((episode, i) => choose.append(element("option", { value: i }, episode.label)));
    const strip = element("div", { class: "strip", "aria-label": "the action of each decision" });
    const scrub = element("input", { type: "range", class: "scrub", min: 0, step: 0.05, "aria-label": "time, seconds" });
    const facts = element("dl", { class: "facts" });
    const values = element("div", { class: "q" });
    const said = element("p", { class: "said" });
    const valuesHead = element("h4"), saidHead = element("h4");
    root.append(
      element("div", { class: "controls" }, choose), view.canvas, strip, scrub,
      element("div", { class: "controls" }, play, back, on, pace),
      element("div", { class: "readout" }, element("div", {}, element("h4", {}, "now"), facts), element("div", {}, valuesHead, values), element("div", {}, saidHead, said)),
    );
    let episode = null, time = 0, running = false, clock = null, request = 0, step = -1, cells = [];

    function load(index) {
      episode = data.episodes[index];
      time = 0;
      step = -1;
      scrub.max = episode.actions.length;
      cells = episode.actions.map((action, t) => {
        const cell = element("button", { type: "button", class: `action-${action}`, tabindex: -1, title: `decision ${t + 1}: ${data.actions[action]}` });
        cell.addEventListener("click", () => seek(t));
        return cell;
      });
      strip.replaceChildren(...cells);
      render();
    }
    const seek = (t) => {
      time = Math.min(Math.max(t, 0), episode.actions.length);
      render();
    };
    function setRunning(state) {
      running = state;
      play.textContent = running ? "Pause" : "Play";
      // One frame is asked for at a time: a second chain of them would run the clock at double speed.
      cancelAnimationFrame(request);
      if (!running) return;
      if (time >= episode.actions.length) seek(0);
      clock = null;
      request = requestAnimationFrame(tick);
    }
    function tick(now) {
      // A frame's time may lie before the click that asked for it, so the clock starts with the first frame. A tab that
      // was hidden gets its next frame after minutes: no frame counts for more than a tenth of a second.
      const passed = clock === null ? 0 : Math.min(Math.max(now - clock, 0), 100) / 1000;
      clock = now;
      seek(time + passed * Number(pace.value));
      if (time >= episode.actions.length) return setRunning(false);
      request = requestAnimationFrame(tick);
    }

    // Between two observations, a second apart, a vehicle follows the cubic that keeps its place and velocity at both.
    const cubic = (p0, v0, p1, v1, u) => {
      const a = u * u, b = a * u;
      return (2 * b - 3 * a + 1) * p0 + (b - 2 * a + u) * v0 + (3 * a - 2 * b) * p1 + (b - a) * v1;
    };
    function scene(t) {
      const i = Math.min(Math.floor(t), episode.frames.length - 1), u = t - i;
      const before = episode.frames[i], after = episode.frames[i + 1];
      if (!after || u < 1e-6) return before.map(([track, row, x, y, vx, vy]) => ({ track, row, x, y, vx, vy, alpha: 1 }));
      const next = new Map(after.map((car) => [car[0], car]));
      const cars = before.map(([track, row, x, y, vx, vy]) => {
        const to = next.get(track);
        next.delete(track);
        if (!to) return { track, row, x: x + vx * u, y: y + vy * u, vx, vy, alpha: 1 - u };
        const mix = (p, q) => p + (q - p) * u;
        return { track, row, x: cubic(x, vx, to[2], to[4], u), y: cubic(y, vy, to[3], to[5], u), vx: mix(vx, to[4]), vy: mix(vy, to[5]), alpha: 1 };
      });
      for (const [track, row, x, y, vx, vy] of next.values()) cars.push({ track, row, x: x - vx * (1 - u), y: y - vy * (1 - u), vx, vy, alpha: u });
      return cars;
    }

    function paint(cars) {
      const { canvas } = view, ratio = window.devicePixelRatio || 1;
      const width = canvas.clientWidth || 600, scale = Math.max(width / 150, 5), lane = 4 * scale, edge = 26;
      const height = episode.lanes * lane + 2 * edge;
      if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
        canvas.width = Math.round(width * ratio);
        canvas.height = Math.round(height * ratio);
        canvas.style.height = `${height}px`;
      }
      const pen = canvas.getContext("2d"), ego = cars.find((car) => car.track === 0);
      const origin = width * 0.3, X = (x) => origin + (x - ego.x) * scale, Y = (y) => edge + lane / 2 + y * scale;
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.fillStyle = color("--grass");
      pen.fillRect(0, 0, width, height);
      pen.fillStyle = color("--road");
      pen.fillRect(0, edge, width, episode.lanes * lane);
      pen.strokeStyle = color("--mark");
      pen.lineWidth = 2;
      for (let i = 0; i <= episode.lanes; i++) {
        const inner = i > 0 && i < episode.lanes;
        pen.setLineDash(inner ? [3 * scale, 5 * scale] : []);
        pen.lineDashOffset = inner ? (ego.x % 8) * scale - origin : 0;
        pen.beginPath();
        pen.moveTo(0, edge + i * lane);
        pen.lineTo(width, edge + i * lane);
        pen.stroke();
      }
      pen.setLineDash([]);
      pen.font = "11px system-ui, sans-serif";
      pen.textAlign = "center";
      pen.textBaseline = "middle";
      pen.fillStyle = color("--soft");
      for (let x = Math.ceil((ego.x - origin / scale) / 20) * 20; X(x) < width; x += 20) {
        pen.fillRect(X(x), edge + episode.lanes * lane + 3, 1, 4);
        pen.fillText(`${x} m`, X(x), edge + episode.lanes * lane + 15);
      }
      const ended = time >= episode.actions.length && episode.crashed;
      for (const car of [...cars].sort((a, b) => b.track - a.track)) {
        const mine = car.track === 0;
        pen.save();
        pen.globalAlpha = car.alpha;
        pen.translate(X(car.x), Y(car.y));
        pen.rotate(Math.atan2(car.vy, Math.max(Math.abs(car.vx), 1)));
        pen.fillStyle = color(mine ? (ended ? "--crash" : "--ego") : "--car");
        pen.beginPath();
        pen.roundRect(-2.5 * scale, -scale, 5 * scale, 2 * scale, Math.min(4, scale * 0.5));
        pen.fill();
        pen.fillStyle = color("--paper");
        pen.fillText(mine ? "ego" : car.row, 0, 0.5);
        pen.restore();
      }
      if (ended) {
        pen.fillStyle = color("--crash");
        pen.font = "600 14px system-ui, sans-serif";
        pen.fillText("crash", X(ego.x), Math.max(Y(ego.y) - 1.9 * scale, 12));
      }
    }

    function render() {
      const cars = scene(time), ego = cars.find((car) => car.track === 0);
      paint(cars);
      const last = episode.actions.length, now = Math.min(Math.floor(time), last - 1);
      if (document.activeElement !== scrub || running) scrub.value = time;
      scrub.setAttribute("aria-valuetext", `${time.toFixed(1)} s, ${data.actions[episode.actions[now]]}`);
      const earned = episode.rewards.slice(0, Math.min(Math.floor(time + 1e-9), last)).reduce((sum, r) => sum + (r || 0), 0);
      const lane = Math.min(Math.max(Math.round(ego.y / 4), 0), episode.lanes - 1) + 1;
      const pairs = [
        ["time", `${time.toFixed(1)} s`], ["speed", `${Math.hypot(ego.vx, ego.vy).toFixed(1)} m/s`], ["lane", `${lane} of ${episode.lanes}`],
        ["action", data.actions[episode.actions[now]]], ["reward", (episode.rewards[now] || 0).toFixed(3)], ["return so far", earned.toFixed(2)],
      ];
      facts.replaceChildren(...pairs.map(([name, value]) => element("div", {}, element("dt", {}, name), element("dd", {}, value))));
      if (now === step) return;
      step = now;
      cells.forEach((cell, t) => (cell.className = `action-${episode.actions[t]}${t <= now ? " done" : ""}${t === now ? " now" : ""}`));
      const q = episode.q && episode.q[now];
      valuesHead.textContent = q ? "value of each action" : "this driver gives no values";
      values.replaceChildren();
      if (q) {
        const known = q.filter((v) => v !== null), low = Math.min(...known), high = Math.max(...known);
        q.forEach((value, action) => {
          const mark = action === episode.actions[now] ? { class: "chosen" } : {};
          const bar = element("i");
          bar.style.width = `${value === null ? 0 : 8 + (92 * (value - low)) / Math.max(high - low, 1e-9)}%`;
          bar.style.background = `var(${ACTIONS[action]})`;
          values.append(element("span", mark, data.actions[action]), element("span", { class: "bar" }, bar), element("span", mark, value === null ? "–" : value.toFixed(3)));
        });
      }
      const words = episode.said[now] || "";
      saidHead.textContent = episode.said.length ? `${episode.agent} says` : "";
      said.textContent = words || (episode.said.length ? "(nothing)" : "");
    }

    play.addEventListener("click", () => setRunning(!running));
    back.addEventListener("click", () => { setRunning(false); seek(Math.ceil(time) - 1); });
    on.addEventListener("click", () => { setRunning(false); seek(Math.floor(time) + 1); });
    scrub.addEventListener("input", () => { setRunning(false); seek(Number(scrub.value)); });
    choose.addEventListener("change", () => { setRunning(false); load(Number(choose.value)); });
    root.addEventListener("keydown", (event) => {
      if (event.target.tagName === "SELECT") return;
      if (event.key === " " && event.target.tagName !== "BUTTON") setRunning(!running);
      else if (event.key === "ArrowLeft") { setRunning(false); seek(Math.ceil(time) - 1); }
      else if (event.key === "ArrowRight") { setRunning(false); seek(Math.floor(time) + 1); }
      else return;
      if (event.target === scrub) scrub.value = time;
      event.preventDefault();
    });
    new ResizeObserver(() => episode && render()).observe(root);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => render());
    load(0);
  }
  const stage = document.getElementById("watch-canvas");
  if (stage) {
    const figure = element("figure", { class: "player", tabindex: 0, "aria-label": "player: space plays and pauses, arrow keys step" });
    stage.append(figure);
    player(figure);
  }
})();
