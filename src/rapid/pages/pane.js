// One episode on a page: its road, what it earns decision by decision, and what its driver sees, values and says.

const fact = (name) => {
  const value = element("dd");
  return { value, node: element("div", {}, element("dt", {}, name), value) };
};
// Text is set only when it changes: a page that plays does this sixty times a second.
const say = (node, words) => {
  if (node.textContent !== words) node.textContent = words;
};

function makePane(names, onSeek) {
  const canvas = element("canvas", { role: "img", "aria-label": "The road from above" });
  const strip = element("div", { class: "strip", role: "group", "aria-label": "the decisions: colour is the action, height the reward" });
  const heat = element("div", { class: "heat-map" });
  const over = element("details", { class: "over-time" }, element("summary", {}, "Which policy decides about which car, over time"), heat);
  const facts = Object.fromEntries(["speed", "lane", "reward", "return"].map((name) => [name, fact(name)]));
  const values = element("div", { class: "q" }), valuesHead = element("h4");
  const words = element("div", { class: "words" });
  const score = element("output", { class: "score" });
  const head = element("header", { class: "pane-head" }, score);
  const view = element("div", { class: "view" }, canvas, strip, over);
  const aside = element("div", { class: "readout" }, element("dl", { class: "facts" }, ...Object.values(facts).map((f) => f.node)), valuesHead, values, words);
  const root = element("section", { class: "pane" }, head, element("div", { class: "pane-body" }, view, aside));
  let episode = null, cells = [], shown = -1, drawn = -1, mark = null;

  function addCells() {
    const highest = Math.max(1e-9, ...episode.rewards.map((reward) => Math.abs(reward ?? 0)));
    for (let t = cells.length; t < lengthOf(episode); t++) {
      const cell = button(element("i"), { tabindex: -1 }, () => onSeek(t));
      cells.push(cell);
      strip.append(cell);
    }
    cells.forEach((cell, t) => {
      const action = episode.actions[t], reward = episode.rewards[t];
      cell.title = `decision ${t + 1}: ${names[action]}${reward === null ? "" : `, reward ${reward.toFixed(2)}`}`;
      cell.setAttribute("aria-label", cell.title);
      cell.firstChild.className = `action-${action}`;
      cell.firstChild.style.height = `${(18 + (82 * Math.max(reward ?? 0, 0)) / highest).toFixed(0)}%`;
    });
  }

  function drawHeat() {
    mark = null;
    heat.replaceChildren();
    const has = episode.routing?.some((weights) => weights && weights[0]?.length > 1);
    over.hidden = !has;
    if (!has || !over.open) return;
    const tracks = [...new Set(episode.frames.flatMap((frame) => frame.filter((car) => car[1] < episode.vehicles).map((car) => car[0])))].sort((a, b) => a - b);
    const columns = lengthOf(episode), size = 9;
    const svg = shape("svg", { viewBox: `0 0 ${columns * 10} ${tracks.length * size}`, preserveAspectRatio: "none", role: "img", "aria-label": "A line for each car, the ego first; a column for each decision; the colour is the adapter's share." });
    svg.style.height = `${tracks.length * size}px`;
    for (let t = 0; t < columns; t++) {
      for (const [track, row] of episode.frames[t]) {
        const share = adapterShare(episode, t, row);
        if (share === null) continue;
        const cell = shape("rect", { x: t * 10 + 0.5, y: tracks.indexOf(track) * size + 0.5, width: 9, height: size - 1 }, shape("title", {}, `decision ${t + 1}, ${track ? `car ${row}` : "ego"}: ${episode.routing[t][row].map((w) => signed(w, 3)).join(" and ")}`));
        cell.style.fill = blend("--one", "--two", share);
        svg.append(cell);
      }
    }
    mark = shape("rect", { class: "now", x: Math.max(shown, 0) * 10, y: 0, width: 10, height: tracks.length * size });
    svg.append(mark);
    svg.addEventListener("click", (event) => {
      const box = svg.getBoundingClientRect();
      onSeek(Math.floor(((event.clientX - box.left) / box.width) * columns));
    });
    heat.append(svg);
  }
  over.addEventListener("toggle", () => episode && drawHeat());

  function showDecision(now) {
    cells.forEach((cell, t) => (cell.className = `${t <= now ? "done" : ""}${t === now ? " now" : ""}`));
    mark?.setAttribute("x", now * 10);
    const chosen = episode.actions[now], q = episode.q?.[now], verdict = episode.verdict?.[now];
    say(valuesHead, q ? "value of each action" : verdict ? "the filter's verdict" : "");
    values.replaceChildren();
    if (q || verdict) {
      const known = (q ?? []).filter((v) => v !== null), low = Math.min(...known), high = Math.max(...known);
      names.forEach((name, action) => {
        const value = q?.[action] ?? null, mark = action === chosen ? { class: "chosen" } : {};
        const bar = element("i", { class: `action-${action}` });
        bar.style.width = `${value === null ? 0 : 8 + (92 * (value - low)) / Math.max(high - low, 1e-9)}%`;
        const safe = verdict ? element("span", { class: verdict.safe[action] ? "safe" : "unsafe" }, verdict.safe[action] ? "safe" : "unsafe") : "";
        values.append(element("span", mark, name), element("span", { class: "bar" }, bar), element("span", mark, value === null ? "–" : value.toFixed(2)), safe || element("span"));
      });
    }
    words.replaceChildren(...spoken(episode, now, names));
  }

  return {
    root, head, canvas,
    // How many seconds the width stands for: both panes and the slider share one scale.
    span(seconds) {
      strip.style.setProperty("--cells", Math.max(Math.ceil(seconds), 1));
    },
    show(next) {
      episode = next;
      cells = [];
      shown = drawn = -1;
      strip.replaceChildren();
      addCells();
      drawHeat();
    },
    // More decisions were driven: what is shown of the others stays as it is.
    grow() {
      addCells();
      drawHeat();
      shown = -1;
    },
    render(time, look) {
      const t = Math.min(time, lengthOf(episode)), now = decisionAt(episode, t);
      const ego = carsAt(episode, t).find((car) => car.track === 0), ended = t >= lengthOf(episode) && episode.ended !== false;
      paintInto(canvas, episode, t, { ...look, masked: look.masked && episode.human });
      say(facts.speed.value, `${Math.hypot(ego.vx, ego.vy).toFixed(1)} m/s`);
      say(facts.lane.value, `${laneOf(ego.y, episode.lanes)} of ${episode.lanes}`);
      say(facts.reward.value, lengthOf(episode) ? (episode.rewards[now] ?? 0).toFixed(3) : "–");
      say(facts.return.value, earned(episode, t).toFixed(2));
      say(score, ended ? `${episode.crashed ? "crashed" : "arrived"} after ${lengthOf(episode)} s, return ${earned(episode, t).toFixed(2)}` : "");
      score.classList.toggle("bad", ended && episode.crashed);
      if (now !== shown && lengthOf(episode)) {
        shown = now;
        showDecision(now);
      }
      if (Math.floor(t) !== drawn) {
        drawn = Math.floor(t);
        canvas.setAttribute("aria-label", `The road from above. ${describe(episode, t, names)}`);
      }
    },
  };
}

// What was told to a driver, what it answered and what was computed: three things, each with its own name.
function spoken(episode, now, names) {
  const parts = [];
  const part = (title, text) => text && parts.push(element("h4", {}, title), element("p", { class: "said" }, text));
  part(`told to ${episode.agent}`, episode.told?.[now]);
  part(`${episode.agent} answered`, episode.answered?.[now]);
  const odds = episode.odds?.[now];
  if (odds) part("its probabilities", names.map((name, action) => [name, odds[action]]).filter(([, p]) => p > 0.005).map(([name, p]) => `${name} ${(100 * p).toFixed(0)} %`).join(", "));
  part("computed by us", episode.computed?.[now]);
  const verdict = episode.verdict?.[now];
  if (verdict?.wanted !== undefined && verdict.wanted !== episode.actions[now]) part("the filter", `wanted ${names[verdict.wanted]}, which it does not call safe; took ${names[episode.actions[now]]}`);
  return parts;
}
