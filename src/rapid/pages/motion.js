// Where everything is at a time between two decisions. An episode of T decisions has T + 1 frames, a second apart; a
// frame is a list of cars [track, row, x, y, vx, vy] in metres and m/s, the ego with track 0.

const lengthOf = (episode) => episode.actions.length;
const decisionAt = (episode, t) => clamp(Math.floor(t + 1e-9), 0, Math.max(lengthOf(episode) - 1, 0));

// The cubic that keeps place and velocity at both ends of a second, at share u of it: its place and its velocity.
const place = (p0, v0, p1, v1, u) => {
  const a = u * u, b = a * u;
  return (2 * b - 3 * a + 1) * p0 + (b - 2 * a + u) * v0 + (3 * a - 2 * b) * p1 + (b - a) * v1;
};
const pace = (p0, v0, p1, v1, u) => {
  const a = u * u;
  return 6 * (u - a) * (p1 - p0) + (3 * a - 4 * u + 1) * v0 + (3 * a - 2 * u) * v1;
};

// All cars at time t. One that comes into view or leaves it fades and keeps its speed.
function carsAt(episode, time) {
  const t = clamp(time, 0, lengthOf(episode)), i = Math.min(Math.floor(t), episode.frames.length - 1), u = t - i;
  const before = episode.frames[i], after = episode.frames[i + 1];
  if (!after) return before.map(([track, row, x, y, vx, vy]) => ({ track, row, x, y, vx, vy, ax: 0, alpha: 1 }));
  const next = new Map(after.map((car) => [car[0], car]));
  const cars = before.map(([track, row, x, y, vx, vy]) => {
    const to = next.get(track);
    next.delete(track);
    if (!to) return { track, row, x: x + vx * u, y: y + vy * u, vx, vy, ax: 0, alpha: 1 - u };
    return {
      track, row, alpha: 1, ax: to[4] - vx,
      x: place(x, vx, to[2], to[4], u), y: place(y, vy, to[3], to[5], u),
      vx: pace(x, vx, to[2], to[4], u), vy: pace(y, vy, to[3], to[5], u),
    };
  });
  for (const [track, row, x, y, vx, vy] of next.values()) {
    cars.push({ track, row, x: x - vx * (1 - u), y: y - vy * (1 - u), vx, vy, ax: 0, alpha: u });
  }
  return cars;
}

// What the agent was made to see at the decision under way, moved on with the cars that it stands for: each
// {row, x, y, dx, dy, car}, where `car` is null for a car that is not there. Null where nothing was changed.
function ghostsAt(episode, time, cars) {
  const t = clamp(time, 0, lengthOf(episode)), now = decisionAt(episode, t), seen = episode.seen?.[now];
  if (!seen) return null;
  const rows = new Map(episode.frames[now].map((car) => [car[1], car])), tracks = new Map(cars.map((car) => [car.track, car]));
  return seen.map(([row, x, y, vx, vy]) => {
    const truth = rows.get(row), car = truth && tracks.get(truth[0]);
    if (!car) return { row, x: x + vx * (t - now), y: y + vy * (t - now), dx: 0, dy: 0, car: null };
    return { row, x: car.x + x - truth[2], y: car.y + y - truth[3], dx: x - truth[2], dy: y - truth[3], car };
  });
}

// The share of the adapters in what is thought about the vehicle of a row; null where nothing is known.
const adapterShare = (episode, now, row) => {
  const weights = episode.routing?.[now]?.[row];
  if (!weights || weights.length < 2) return null;
  const sizes = weights.map(Math.abs), all = sizes.reduce((sum, size) => sum + size, 0);
  return all ? 1 - sizes[0] / all : 0;
};
// How much of the attention goes to the vehicle of a row, 1 for the most that one gets at this decision.
const attentionShare = (episode, now, row) => {
  const shares = episode.attention?.[now];
  if (!shares) return null;
  return (shares[row] ?? 0) / Math.max(...shares, 1e-9);
};
const earned = (episode, t) => episode.rewards.slice(0, Math.floor(t + 1e-9)).reduce((sum, reward) => sum + (reward ?? 0), 0);
const crashTime = (episode) => (episode.crashed ? lengthOf(episode) : null);
const laneOf = (y, lanes) => clamp(Math.round(y / 4), 0, lanes - 1) + 1;

// A sentence for those who cannot see the picture.
function describe(episode, t, names) {
  const cars = carsAt(episode, t), ego = cars.find((car) => car.track === 0), now = decisionAt(episode, t);
  const others = cars.filter((car) => car.track && car.alpha > 0.5).sort((a, b) => Math.abs(a.x - ego.x) - Math.abs(b.x - ego.x));
  const near = others.slice(0, 3).map((car) => {
    const away = car.x - ego.x;
    return `a car ${Math.abs(away).toFixed(0)} metres ${away < 0 ? "behind" : "ahead"} in lane ${laneOf(car.y, episode.lanes)} at ${car.vx.toFixed(0)} metres a second`;
  });
  const doing = t >= lengthOf(episode) ? (episode.crashed ? "It has crashed" : "The end") : `It decides: ${names[episode.actions[now]]}`;
  return `Second ${t.toFixed(0)}: the ego is in lane ${laneOf(ego.y, episode.lanes)} of ${episode.lanes} at ${ego.vx.toFixed(0)} metres a second. ${doing}. ${near.length ? `Nearest: ${near.join("; ")}.` : "No other car is near."}`;
}
