// The player: one clock for one or two episodes on the same page, with the controls that both pages share.

const RATES = [0.5, 1, 2, 4];
const MODES = [["routing", "colour: which policy"], ["attention", "colour: attention"], ["plain", "colour: plain"]];

// `options`: names of the actions; more(pane), called when a pane's episode goes on and the clock nears what is known
// of it; keys(event), which may take a key for itself; link(), the address of this moment, if it has one.
function makePlayer(root, options) {
  const names = options.names, panes = [];
  const look = { mode: "routing", ghosts: true, masked: true, calm: matchMedia("(prefers-reduced-motion: reduce)").matches };
  const play = button("Play", { class: "play" }, () => setRunning(!running));
  const crash = button("Crash", { class: "to-crash", title: "to just before the crash (c)" }, () => toCrash());
  const rate = chooser("pace", RATES.map((value) => [value, `${value} × real time`]));
  rate.value = options.pace ?? "2";
  const mode = chooser("what colours mean", MODES);
  const ghosts = element("input", { type: "checkbox" });
  ghosts.checked = true;
  const ghostBox = element("label", { class: "check" }, ghosts, "what it is made to see");
  const scrub = element("input", { type: "range", class: "scrub", min: 0, step: 0.05, "aria-label": "time, seconds" });
  const at = element("output", { class: "at" });
  const legend = element("p", { class: "legend" });
  const aloud = element("p", { class: "unseen-text", "aria-live": "polite" });
  const stage = element("div", { class: "stage" });
  const controls = element(
    "div", { class: "controls" }, play,
    button("‹", { "aria-label": "one decision back" }, () => step(-1)),
    button("›", { "aria-label": "one decision on" }, () => step(1)),
    at, crash, rate, mode, ghostBox,
  );
  root.append(stage, scrub, controls, legend, aloud);
  let time = 0, running = false, clock = null, request = 0, waiting = false, dragged = false, wanted = null;

  const episodes = () => panes.filter((pane) => pane.episode).map((pane) => pane.episode);
  const end = () => Math.max(0, ...episodes().map(lengthOf));
  const goesOn = () => episodes().some((episode) => episode.ended === false);

  function seek(t) {
    time = clamp(t, 0, end());
    render();
  }
  function setRunning(state) {
    running = state;
    say(play, running ? "Pause" : "Play");
    // One frame is asked for at a time: a second chain of them would run the clock at double speed.
    cancelAnimationFrame(request);
    if (!running) return;
    if (time >= end() && !goesOn()) seek(0);
    clock = null;
    request = requestAnimationFrame(tick);
  }
  function tick(now) {
    // A frame's time may lie before the click that asked for it, so the clock starts with the first frame. A tab that
    // was hidden gets its next frame after minutes: no frame counts for more than a tenth of a second.
    const passed = clock === null ? 0 : clamp(now - clock, 0, 100) / 1000;
    clock = now;
    // An episode that goes on holds the clock until its next decision is known, so that both stay together.
    const known = Math.min(end(), ...episodes().filter((episode) => episode.ended === false).map(lengthOf));
    const next = time + passed * Number(rate.value);
    waiting = next >= known && goesOn();
    seek(Math.min(next, known));
    for (const pane of panes) {
      const { episode } = pane;
      if (episode?.ended === false && lengthOf(episode) - time < (episode.human ? 1e-6 : 0.6)) options.more(pane.index);
    }
    if (time >= end() && !goesOn()) return setRunning(false);
    request = requestAnimationFrame(tick);
  }
  function step(by) {
    setRunning(false);
    const to = by < 0 ? Math.ceil(time - 1e-9) - 1 : Math.floor(time + 1e-9) + 1;
    wanted = to > end() && goesOn() ? to : null;
    seek(to);
    if (wanted !== null) for (const pane of panes) if (pane.episode?.ended === false) options.more(pane.index);
    say(aloud, panes.filter((pane) => pane.episode).map(({ episode }) => `${episode.agent}: ${describe(episode, Math.min(time, lengthOf(episode)), names)}`).join(" "));
  }
  const crashes = () => episodes().map(crashTime).filter((t) => t !== null).sort((a, b) => a - b);
  function toCrash() {
    const found = crashes();
    if (!found.length) return;
    // The next one after the moment shown, then the first again.
    seek((found.find((t) => t - 3 > time + 1e-6) ?? found[0]) - 3);
    setRunning(true);
  }

  function render() {
    const shown = panes.filter((pane) => pane.episode);
    if (!shown.length) return;
    for (const pane of shown) pane.view.render(time, { ...look, masked: pane.episode.ended === false });
    const most = Math.max(end(), ...episodes().map((episode) => episode.limit ?? 0), 0.05);
    if (Number(scrub.max) !== most) {
      scrub.max = most;
      for (const pane of panes) pane.view.span(most);
    }
    if (!dragged) scrub.value = time;
    const first = shown[0].episode, action = lengthOf(first) ? names[first.actions[decisionAt(first, time)]] : "";
    scrub.setAttribute("aria-valuetext", `${time.toFixed(1)} s, ${action}`);
    say(at, `${time.toFixed(1)} s${waiting && running ? " …" : ""}`);
    options.onTime?.(time, running);
  }
  function explain() {
    const swatch = (name, words) => {
      const i = element("i", { class: "swatch" });
      i.style.background = name.startsWith("linear") ? name : `var(${name})`;
      return element("span", {}, i, words);
    };
    const parts = names.map((name, action) => swatch(ACTIONS[action], name));
    const routed = episodes().some((episode) => episode.routing?.some((weights) => weights?.[0]?.length > 1));
    const attended = episodes().some((episode) => episode.attention);
    if (look.mode === "routing" && routed) parts.push(swatch("linear-gradient(90deg, var(--one), var(--two))", "policy 1 to adapter"));
    if (look.mode === "attention" && attended) parts.push(swatch("linear-gradient(90deg, var(--car), var(--gaze))", "little to most attention"));
    const attacked = episodes().some((episode) => episode.seen?.some(Boolean));
    if (attacked) parts.push(swatch("--ghost", "what the agent is made to see"));
    ghostBox.hidden = !attacked;
    mode.hidden = !routed && !attended;
    crash.hidden = !crashes().length;
    legend.replaceChildren(...parts);
  }

  rate.addEventListener("change", () => (clock = null));
  mode.addEventListener("change", () => { look.mode = mode.value; explain(); render(); });
  ghosts.addEventListener("change", () => { look.ghosts = ghosts.checked; render(); });
  // While a thumb is held the clock does not move it.
  scrub.addEventListener("pointerdown", () => (dragged = true));
  for (const name of ["pointerup", "pointercancel", "blur"]) scrub.addEventListener(name, () => (dragged = false));
  scrub.addEventListener("input", () => { setRunning(false); seek(Number(scrub.value)); });
  root.addEventListener("keydown", (event) => {
    const tag = event.target.tagName, typing = tag === "SELECT" || (tag === "INPUT" && event.target !== scrub);
    if (typing || event.ctrlKey || event.metaKey || event.altKey || options.keys?.(event)) return;
    const acts = { ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => { setRunning(false); seek(0); }, End: () => { setRunning(false); seek(end()); }, c: toCrash };
    if (event.key === " " && tag !== "BUTTON" && tag !== "SUMMARY") acts[" "] = () => setRunning(!running);
    if (!acts[event.key]) return;
    event.preventDefault();
    acts[event.key]();
    scrub.value = time;
  });
  new ResizeObserver(render).observe(stage);
  onScheme.push(render);

  const player = {
    root, stage, controls, look, seek, toCrash, setRunning, render,
    get time() { return time; },
    get running() { return running; },
    get episodes() { return episodes(); },
    addPane() {
      const index = panes.length, view = makePane(names, (t) => { setRunning(false); seek(t); });
      panes.push({ index, view, episode: null });
      stage.append(view.root);
      return view;
    },
    // Show an episode in a pane, from its beginning; null empties the pane.
    show(index, episode) {
      setRunning(false);
      const pane = panes[index];
      pane.episode = episode;
      pane.view.root.classList.toggle("empty", !episode);
      if (episode) pane.view.show(episode);
      time = 0;
      explain();
      render();
    },
    // More of an episode is known.
    grow(index) {
      panes[index].view.grow();
      explain();
      // A step on that had to be driven first.
      if (wanted !== null && end() >= wanted) [time, wanted] = [wanted, null];
      render();
    },
  };
  addSharing(player, options);
  return player;
}
