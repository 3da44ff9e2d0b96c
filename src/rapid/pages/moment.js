// A moment of two episodes as words of an address: where, on which spawn, who drives, at which second, and all that the
// reader did until then. Agents decide again as they did, so nothing else has to be kept.

const PANES = ["left", "right"];

// A list with one entry a decision as "from entry value, ..." wherever the value changes.
function packed(values) {
  const parts = [];
  values.forEach((value, t) => {
    if (t === 0 ? value !== "none" : value !== values[t - 1]) parts.push(`${t}-${value}`);
  });
  return parts.join("_");
}
function unpacked(text) {
  const steps = text.split("_").map((part) => /^(\d+)-([a-z-]+(?:\*[\d.]+)?)$/.exec(part)).filter(Boolean);
  return (t) => steps.filter((step) => Number(step[1]) <= t).at(-1)?.[2] ?? "none";
}

// `asked` has for each pane the attack that was asked for at each decision, as KIND*METRES or none.
function writeMoment(choice, episodes, asked, time) {
  const words = new URLSearchParams({ scenario: choice.scenario, spawn: choice.spawn });
  PANES.forEach((name, pane) => {
    if (!choice[name]) return;
    words.set(name, choice[name]);
    const attacks = packed(asked[pane]);
    if (attacks) words.set(`${name}-attack`, attacks);
    if (episodes[pane]?.human) words.set(`${name}-actions`, episodes[pane].actions.join(""));
  });
  if (time > 0) words.set("t", time.toFixed(1));
  return words.toString();
}

function readMoment(hash) {
  const words = new URLSearchParams(hash.replace(/^#/, ""));
  const spawn = words.get("spawn"), t = Number(words.get("t") ?? 0);
  const moment = { scenario: words.get("scenario"), time: Number.isFinite(t) ? clamp(t, 0, 1000) : 0, scripts: [] };
  moment.spawn = /^\d{1,15}$/.test(spawn ?? "") ? Number(spawn) : null;
  PANES.forEach((name) => {
    moment[name] = words.get(name) ?? "";
    const actions = (words.get(`${name}-actions`) ?? "").replace(/[^0-4]/g, ""), attack = unpacked(words.get(`${name}-attack`) ?? "");
    moment.scripts.push({ action: (decision) => (decision < actions.length ? Number(actions[decision]) : 1), attack });
  });
  return moment;
}
