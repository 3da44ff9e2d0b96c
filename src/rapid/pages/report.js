// The page of a run: its tables, its curves, its recorded episodes.

const data = JSON.parse(document.getElementById("payload").textContent);
document.querySelectorAll("table.sortable").forEach(sortable);

const curves = document.getElementById("curves-canvas");
if (curves) {
  const main = element("div", { class: "charts" }), rest = element("div", { class: "charts" });
  for (const spec of data.charts) (spec.detail ? rest : main).append(lineChart(spec));
  curves.append(main);
  if (rest.childElementCount) curves.append(element("details", {}, element("summary", {}, "Terms of the losses"), rest));
}

const worst = document.getElementById("worst-canvas");
if (worst && data.worst.length) worst.append(element("div", { class: "charts" }, ...data.worst.map(lineChart)));

// A moment in the address: #moment=EPISODE,OTHER,SECONDS
const readMoment = () => {
  const found = /^#moment=(\d+),(\d*),(\d+(?:\.\d+)?)$/.exec(location.hash);
  const known = (index) => index !== "" && Number(index) < data.episodes.length;
  if (!found || !known(found[1])) return null;
  return { first: Number(found[1]), second: known(found[2]) ? Number(found[2]) : null, time: Number(found[3]) };
};

function recordedPlayer(place) {
  const root = element("figure", { class: "player", tabindex: 0, "aria-label": "player: space plays and pauses, arrow keys step, c goes to the crash" });
  place.append(root);
  const link = () => `${location.href.split("#")[0]}#moment=${first.value},${second.value},${player.time.toFixed(1)}`;
  const player = makePlayer(root, { names: data.actions, more: () => {}, link });
  const listed = data.episodes.map((episode, i) => [i, episode.label]);
  const first = chooser("episode", listed, { class: "episode" });
  const second = chooser("beside it", [["", "alone"], ...listed], { class: "episode" });
  const top = player.addPane(), below = player.addPane();
  top.head.prepend(first);
  below.head.prepend(second);
  first.addEventListener("change", () => player.show(0, data.episodes[first.value]));
  second.addEventListener("change", () => player.show(1, second.value === "" ? null : data.episodes[second.value]));
  const open = (moment) => {
    first.value = moment.first;
    second.value = moment.second ?? "";
    player.show(0, data.episodes[moment.first]);
    player.show(1, moment.second === null ? null : data.episodes[moment.second]);
    player.seek(moment.time);
  };
  // Beside the first episode stands another driver's on the same spawn, if there is one.
  const beside = () => {
    const { agent, scenario, spawn, attack } = data.episodes[0];
    const other = data.episodes.findIndex((e) => e.agent !== agent && e.scenario === scenario && e.spawn === spawn && e.attack === attack);
    return other < 0 ? null : other;
  };
  open(readMoment() ?? { first: 0, second: beside(), time: 0 });
  addEventListener("hashchange", () => {
    const moment = readMoment();
    if (moment) open(moment);
  });
  // Play the last seconds of an episode.
  const playEnd = (index) => {
    open({ first: index, second: null, time: Math.max(lengthOf(data.episodes[index]) - 4, 0) });
    root.scrollIntoView({ block: "nearest" });
    root.focus({ preventScroll: true });
    player.setRunning(true);
  };
  return { playEnd, player };
}

// The gallery: each crash as a small picture of its last moment; a click plays its last seconds above.
function crashGallery(place, { playEnd, player }) {
  const list = element("ul", { class: "gallery" });
  data.episodes.forEach((episode, i) => {
    if (!episode.crashed) return;
    const canvas = element("canvas", { "aria-hidden": "true" });
    const words = element("span", {}, element("b", {}, episode.agent), ` ${episode.attack === "none" ? "not attacked" : `under ${episode.attack}`}, spawn ${episode.spawn}, after ${lengthOf(episode)} s`);
    const card = button("", { class: "crash-card" }, () => playEnd(i));
    card.append(canvas, words);
    list.append(element("li", {}, card));
    // A picture that moves while the pointer rests on it: the last three seconds, again and again.
    let request = 0, began = null;
    const still = () => paintInto(canvas, episode, lengthOf(episode), { mode: "routing", ghosts: true, calm: true });
    const move = (now) => {
      began ??= now;
      paintInto(canvas, episode, lengthOf(episode) - 3 + Math.min(((now - began) / 1000) % 4.2, 3), { mode: "routing", ghosts: true, calm: true });
      request = requestAnimationFrame(move);
    };
    card.addEventListener("pointerenter", () => {
      cancelAnimationFrame(request);
      began = null;
      if (!player.look.calm) request = requestAnimationFrame(move);
    });
    card.addEventListener("pointerleave", () => { cancelAnimationFrame(request); still(); });
    new ResizeObserver(still).observe(card);
    onScheme.push(still);
  });
  if (list.childElementCount) place.append(element("h3", {}, "Crashes"), list);
}

const watch = document.getElementById("watch-canvas");
if (watch) {
  const recorded = recordedPlayer(watch);
  crashGallery(watch, recorded);
  for (const cell of document.querySelectorAll("a[data-crash]")) {
    cell.addEventListener("click", (event) => {
      event.preventDefault();
      recorded.playEnd(Number(cell.dataset.crash));
    });
  }
}
