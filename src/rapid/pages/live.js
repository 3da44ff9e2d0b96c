// The live page: who drives is chosen here and driven by the program that serves it, decision by decision.

const data = JSON.parse(document.getElementById("payload").textContent);
const KEYS = { ArrowUp: 0, ArrowDown: 2, ArrowRight: 3, ArrowLeft: 4 };
const TUNING = 800000, TUNED = 100000;

const home = document.getElementById("live");
const field = (words, node) => element("label", { class: "field" }, element("span", {}, words), node);
const scenario = chooser("scenario", data.scenarios.map(({ name }) => [name, name]));
const spawn = element("input", { type: "number", min: 0, max: 999999999, step: 1, "aria-label": "spawn", class: "spawn" });
const attack = chooser("attack", [["none", "no attack"], ...data.attacks.map(({ key, label }) => [key, label])]);
const size = element("input", { type: "range", min: 0, max: data.metres, step: 0.5, value: 20, "aria-label": "size of the attack, metres along the road" });
const sizeWords = element("output", { class: "size" });
const status = element("p", { class: "status", role: "status" });
const figure = element("figure", { class: "player", tabindex: 0, "aria-label": "player: space plays and pauses" });
const panes = PANES.map(() => ({ view: null, episode: null, ride: 0, asking: false, asked: [], next: 1, script: null, until: 0 }));
let socket = null, lost = false, startAt = null, tries = 0;

home.append(
  element(
    "header", { class: "live-head" },
    element("h1", {}, "RAPID, live"),
    element(
      "div", { class: "choices" },
      field("scenario", scenario),
      field("spawn", spawn), button("another", { title: "other traffic" }, () => begin({ spawn: TUNING + Math.floor(Math.random() * TUNED) })),
      field("attack", attack),
      element("label", { class: "field wide" }, element("span", {}, "how far every car is moved at most"), element("span", { class: "slider" }, size, sizeWords)),
    ),
  ),
  status, figure,
);

const human = () => panes.filter((pane) => pane.episode?.human && pane.episode.ended === false);
const choice = () => ({ scenario: scenario.value, spawn: Number(spawn.value), left: panes[0].who.value, right: panes[1].who.value });
const wanted = () => (attack.value === "none" || !Number(size.value) ? "none" : `${attack.value}*${size.value}`);
const moment = () => writeMoment(choice(), panes.map((pane) => pane.episode), panes.map((pane) => pane.asked), player.time);

const player = makePlayer(figure, {
  names: data.actions, pace: "1", more, keys: steer,
  link: () => `${location.href.split("#")[0]}#${moment()}`,
  onTime: () => panes.forEach((pane) => pane.pad && (pane.pad.hidden = !(pane.episode?.human && pane.episode.ended === false))),
});

const groups = new Map();
for (const agent of data.agents) groups.set(agent.group, [...(groups.get(agent.group) ?? []), agent]);
panes.forEach((pane, index) => {
  pane.view = player.addPane();
  pane.who = element("select", { "aria-label": index ? "who drives below" : "who drives above", class: "episode" });
  if (index) pane.who.append(element("option", { value: "" }, "nobody"));
  for (const [group, agents] of groups) {
    const list = element("optgroup", { label: group });
    for (const agent of agents) list.append(element("option", { value: agent.key }, agent.label + (agent.scenario ? `, of ${agent.scenario}` : "")));
    pane.who.append(list);
  }
  pane.note = element("output", { class: "pane-note" });
  pane.find = button("find a crash", { title: "drive spawn after spawn until this driver crashes" }, () => ask(index, { type: "find", ...who(index), ...attackNow() }, "looking for a crash …"));
  pane.pad = element("div", { class: "pad", role: "group", "aria-label": "what you do next" });
  for (const [action, sign] of [[4, "←"], [0, "↑"], [2, "↓"], [3, "→"]]) {
    pane.pad.append(button(`${sign} ${data.actions[action]}`, { "data-action": action }, () => decide(pane, action)));
  }
  pane.pad.hidden = true;
  pane.view.head.prepend(pane.who, pane.find, pane.note);
  pane.view.canvas.after(pane.pad);
  pane.who.addEventListener("change", () => open(index));
});

const who = (index) => ({ scenario: scenario.value, spawn: Number(spawn.value), agent: panes[index].who.value });
const attackNow = () => ({ attack: attack.value, metres: Number(size.value) });
function showSize() {
  const share = Number(size.value) / data.along, lanes = data.scenarios.find(({ name }) => name === scenario.value)?.lanes ?? 3;
  sizeWords.value = attack.value === "none" ? "" : `${size.value} m along, ${+(share * 4 * lanes).toFixed(2)} m across, ${+(share * 80).toFixed(1)} m/s; ε = ${+share.toFixed(4)}`;
  size.disabled = attack.value === "none";
}

// The reader's own driving: a key is for the next decision, and one decision is made a second.
function decide(pane, action) {
  pane.next = action;
  pane.pad.querySelectorAll("button").forEach((node) => node.classList.toggle("chosen", Number(node.dataset.action) === action));
  if (!player.running) player.setRunning(true);
}
function steer(event) {
  const action = KEYS[event.key], driven = human();
  if (action === undefined || !driven.length) return false;
  event.preventDefault();
  driven.forEach((pane) => decide(pane, action));
  return true;
}

function tell(words, bad = false) {
  say(status, words);
  status.classList.toggle("bad", bad);
}
function ask(index, message, words) {
  if (socket?.readyState !== WebSocket.OPEN) return tell("The program that drives does not answer. It may have ended: start rapid play again.", true);
  const pane = panes[index];
  pane.asking = true;
  if (words) pane.note.value = words;
  socket.send(JSON.stringify({ pane: index, ride: pane.ride, ...message }));
}
// The next decision of a pane: as it was, while a moment is driven again, else as the reader has it now.
function more(index) {
  const pane = panes[index];
  if (pane.asking || !pane.episode || pane.episode.ended) return;
  const decision = lengthOf(pane.episode), again = pane.script && decision < pane.until;
  const asked = again ? pane.script.attack(decision) : wanted(), [kind, metres] = asked.split("*");
  pane.asked[decision] = asked;
  const action = pane.episode.human ? (again ? pane.script.action(decision) : pane.next) : null;
  pane.next = 1;
  pane.pad.querySelectorAll("button").forEach((node) => node.classList.remove("chosen"));
  ask(index, { type: "step", action, attack: kind, metres: Number(metres ?? (kind === "none" ? 0 : size.value)) });
}
function open(index, script = null, until = 0) {
  const pane = panes[index];
  pane.ride++;
  Object.assign(pane, { episode: null, asked: [], next: 1, script, until });
  player.show(index, null);
  pane.note.value = "";
  pane.find.hidden = !pane.who.value || pane.who.value === "you";
  history.replaceState(null, "", `#${moment()}`);
  if (pane.who.value) ask(index, { type: "open", ...who(index) });
}
// Begin both panes anew, with whatever is changed; `at` has the moment that is driven to.
function begin(changes = {}, at = null) {
  if (changes.spawn !== undefined) spawn.value = changes.spawn;
  startAt = at && at.time > 0 ? at.time : null;
  tell(startAt ? `Driving to second ${startAt.toFixed(0)} …` : "");
  panes.forEach((_, index) => open(index, at?.scripts[index], at ? Math.ceil(at.time) : 0));
}
// While a moment is driven again, the panes go on until both are there.
function catchUp() {
  if (startAt === null) return;
  const late = panes.filter((pane) => pane.who.value && !(pane.episode && (pane.episode.ended || lengthOf(pane.episode) >= Math.ceil(startAt))));
  late.forEach((pane) => more(panes.indexOf(pane)));
  if (late.length) return;
  player.seek(startAt);
  startAt = null;
  tell("");
}

function heard(answer) {
  const pane = panes[answer.pane];
  if (!pane) return tell(answer.message, true);
  if (answer.ride !== pane.ride) return;
  pane.asking = false;
  if (answer.type === "error") {
    player.setRunning(false);
    startAt = null;
    pane.note.value = "";
    tell(answer.message, true);
  } else if (answer.type === "opened") {
    pane.episode = answer.episode;
    player.show(answer.pane, pane.episode);
    catchUp();
  } else if (answer.type === "stepped") {
    for (const [name, value] of Object.entries(answer.added)) pane.episode[name].push(value);
    Object.assign(pane.episode, { ended: answer.ended, crashed: answer.crashed, attack: answer.attack });
    pane.note.value = answer.note;
    player.grow(answer.pane);
    catchUp();
  } else if (answer.type === "found") {
    pane.note.value = answer.spawn === null ? `no crash on ${answer.driven} spawns` : `crashes on spawn ${answer.spawn}`;
    if (answer.spawn === null) return;
    const asked = wanted();
    begin({ spawn: answer.spawn });
    tell(`Spawn ${answer.spawn}${asked === "none" ? "" : ", with the attack on"}: the driver crashes there. Play it.`);
  }
}

function connect() {
  socket = new WebSocket(`${location.origin.replace("http", "ws")}${location.pathname}live`);
  socket.addEventListener("open", () => {
    const again = lost ? readMoment(`#${moment()}`) : readMoment(location.hash);
    [lost, tries] = [false, 0];
    panes.forEach((pane) => (pane.asking = false));
    if (again.scenario && ![...scenario.options].some(({ value }) => value === again.scenario)) scenario.append(element("option", { value: again.scenario }, again.scenario));
    if (again.scenario) scenario.value = again.scenario;
    const known = (key) => data.agents.some((agent) => agent.key === key), unknown = PANES.map((name) => again[name]).filter((key) => key && !known(key));
    panes[0].who.value = known(again.left) ? again.left : panes[0].who.value;
    panes[1].who.value = known(again.right) ? again.right : "";
    const last = PANES.map((_, i) => again.scripts[i].attack(Math.ceil(again.time))).find((words) => words !== "none")?.split("*");
    if (last && [...attack.options].some(({ value }) => value === last[0])) [attack.value, size.value] = [last[0], last[1] ?? size.value];
    showSize();
    begin({ spawn: again.spawn ?? TUNING }, again);
    if (unknown.length) tell(`Nobody here is called ${unknown.join(" or ")}. Start rapid play with that agent, or choose another one.`, true);
  });
  socket.addEventListener("message", (event) => heard(JSON.parse(event.data)));
  socket.addEventListener("close", () => {
    player.setRunning(false);
    panes.forEach((pane) => (pane.asking = false));
    lost = true;
    tries++;
    tell("The connection was lost. What was driven can still be watched. Trying again …", true);
    if (tries > 5) return tell("The program that drives has ended. What was driven can still be watched; to go on, start rapid play again.", true);
    setTimeout(connect, 400 * tries);
  });
}

scenario.addEventListener("change", () => { showSize(); begin(); });
spawn.addEventListener("change", () => spawn.reportValidity() && begin());
attack.addEventListener("change", showSize);
size.addEventListener("input", showSize);
addEventListener("hashchange", () => location.hash.length > 1 && location.hash !== `#${moment()}` && location.reload());
showSize();
connect();
