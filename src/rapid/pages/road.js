// The road from above, on a canvas of any size; it moves with the ego.

const METRES = 125, CAR = 5, CAR_WIDTH = 2, LANE = 4;
const roadScale = (width) => clamp(width / METRES, 5, 9);
const roadHeight = (width, lanes) => lanes * LANE * roadScale(width) + 2 * vergeOf(width);
const vergeOf = (width) => (width < 520 ? 24 : 34);

// The same number for the same place on every road: bushes stand still while the car drives by.
const chance = (n) => {
  const s = Math.sin(n * 127.1 + 11.7) * 43758.5453;
  return s - Math.floor(s);
};

function paintGround(pen, width, height, verge, scale, X, ego, lanes) {
  const lane = LANE * scale, road = lanes * lane;
  pen.fillStyle = color("--grass");
  pen.fillRect(0, 0, width, height);
  const from = Math.floor((ego.x - width / scale) / 6), to = Math.ceil((ego.x + width / scale) / 6);
  for (let n = from; n <= to; n++) {
    for (const side of [0, 1]) {
      const luck = chance(n * 2 + side);
      if (luck > 0.62) continue;
      const size = (0.35 + 0.9 * chance(n * 2 + side + 0.5)) * Math.min(scale, 6), x = X(n * 6 + luck * 9);
      const y = side ? height - verge * (0.18 + 0.34 * chance(n + 0.3)) : verge * (0.2 + 0.38 * chance(n + 0.7));
      pen.fillStyle = color(luck < 0.3 ? "--bush" : "--tuft");
      pen.beginPath();
      pen.arc(x, y, size, 0, 7);
      pen.arc(x + size * 1.1, y + size * 0.25, size * 0.7, 0, 7);
      pen.fill();
    }
  }
  pen.fillStyle = color("--road");
  pen.fillRect(0, verge - 3, width, road + 6);
  pen.strokeStyle = color("--mark");
  pen.lineWidth = 2;
  for (let i = 0; i <= lanes; i++) {
    const inner = i > 0 && i < lanes;
    pen.setLineDash(inner ? [3 * scale, 5 * scale] : []);
    // A dash keeps its place on the road: metre 0 of the pattern is metre 0 of the road.
    pen.lineDashOffset = inner ? -X(0) % (8 * scale) : 0;
    pen.beginPath();
    pen.moveTo(0, verge + i * lane);
    pen.lineTo(width, verge + i * lane);
    pen.stroke();
  }
  pen.setLineDash([]);
  pen.font = "600 11px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.fillStyle = color("--soft");
  for (let x = Math.ceil((ego.x - width / scale) / 50) * 50; X(x) < width + 30; x += 50) {
    pen.fillRect(X(x) - 0.5, height - verge + 4, 1, 5);
    pen.fillText(`${x} m`, X(x), height - verge + 16);
  }
}

function carBody(pen, scale, fill) {
  const long = CAR * scale, wide = CAR_WIDTH * scale, round = Math.min(wide * 0.38, 7);
  pen.fillStyle = fill;
  pen.beginPath();
  pen.roundRect(-long / 2, -wide / 2, long, wide, [round * 0.8, round, round, round * 0.8]);
  pen.fill();
}

function paintCar(pen, car, scale, fill, { ink, label, braking, ring, blink }) {
  const long = CAR * scale, wide = CAR_WIDTH * scale;
  pen.fillStyle = color("--shade");
  pen.beginPath();
  pen.roundRect(-long / 2 + 1, -wide / 2 + 2.5, long, wide, 5);
  pen.fill();
  carBody(pen, scale, fill);
  pen.fillStyle = color("--glass");
  pen.beginPath();
  pen.roundRect(long * 0.14, -wide * 0.38, long * 0.13, wide * 0.76, 2);
  pen.roundRect(-long * 0.37, -wide * 0.34, long * 0.08, wide * 0.68, 2);
  pen.fill();
  pen.fillStyle = color("--lamp");
  for (const side of [-1, 1]) pen.fillRect(long / 2 - 2, side * wide * 0.34 - 1.2, 2, 2.4);
  if (braking) {
    pen.fillStyle = color("--crash");
    for (const side of [-1, 1]) pen.fillRect(-long / 2 - 0.5, side * wide * 0.32 - 1.6, 2.6, 3.2);
  }
  if (blink) {
    pen.fillStyle = color("--warn");
    for (const end of [-1, 1]) {
      pen.beginPath();
      pen.arc(end * long * 0.44, blink * wide * 0.46, 2.2, 0, 7);
      pen.fill();
    }
  }
  if (ring) {
    pen.strokeStyle = color("--ink");
    pen.lineWidth = 1.6;
    pen.beginPath();
    pen.roundRect(-long / 2 - 2.5, -wide / 2 - 2.5, long + 5, wide + 5, 7);
    pen.stroke();
  }
  if (label === "") return;
  pen.fillStyle = ink;
  pen.font = `600 ${clamp(scale * 1.5, 9, 12)}px system-ui, sans-serif`;
  pen.fillText(label, -long * 0.07, 0.5);
}

function paintGhost(pen, ghost, scale, X, Y, masked) {
  const x = X(ghost.x), y = Y(ghost.y);
  pen.save();
  pen.strokeStyle = pen.fillStyle = color("--ghost");
  pen.lineWidth = 1.4;
  // Who drives by what is shown is not told where the cars really are.
  if (ghost.car && !masked && Math.hypot(ghost.dx, ghost.dy) > 0.4) {
    pen.globalAlpha = 0.7;
    pen.setLineDash([2, 3]);
    pen.beginPath();
    pen.moveTo(X(ghost.car.x), Y(ghost.car.y));
    pen.lineTo(x, y);
    pen.stroke();
  }
  pen.setLineDash([4, 3]);
  pen.translate(x, y);
  pen.globalAlpha = 0.2;
  carBody(pen, scale, color("--ghost"));
  pen.globalAlpha = 1;
  pen.stroke();
  pen.setLineDash([]);
  pen.font = "600 10px system-ui, sans-serif";
  pen.fillText(ghost.row === 0 ? "ego" : ghost.row, 0, 0.5);
  pen.restore();
}

// How a car of the observation is filled, by what the reader wants to know.
function tintOf(episode, now, car, mode, read) {
  if (car.track === 0 && mode !== "routing") return color("--ego");
  if (car.row >= read) return color("--unseen");
  if (mode === "attention") {
    const share = attentionShare(episode, now, car.row);
    return share === null ? color("--car") : blend("--car", "--gaze", share);
  }
  const share = mode === "routing" ? adapterShare(episode, now, car.row) : null;
  return share === null ? color(car.track ? "--car" : "--ego") : blend("--one", "--two", share);
}

// Draw the road of an episode at a time. `look`: mode (routing, attention, plain), ghosts (whether what the agent was
// made to see is drawn), masked (whether only that is drawn, for who drives by it), calm (no turn signals that flash).
function paintRoad(pen, width, episode, time, look) {
  const t = clamp(time, 0, lengthOf(episode)), now = decisionAt(episode, t), read = episode.vehicles ?? Infinity;
  const cars = carsAt(episode, t), ego = cars.find((car) => car.track === 0), ghosts = ghostsAt(episode, t, cars);
  const scale = roadScale(width), verge = vergeOf(width), lane = LANE * scale, height = roadHeight(width, episode.lanes);
  const origin = width * 0.31, X = (x) => origin + (x - ego.x) * scale, Y = (y) => verge + lane / 2 + y * scale;
  paintGround(pen, width, height, verge, scale, X, ego, episode.lanes);
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  const ended = t >= lengthOf(episode) && episode.ended !== false, wreck = ended && episode.crashed;
  const shown = look.masked && ghosts && !ended ? cars.filter((car) => car.track === 0) : cars;
  for (const car of [...shown].sort((a, b) => b.track - a.track)) {
    if (X(car.x) < -60 || X(car.x) > width + 60) continue;
    const mine = car.track === 0, action = mine && !ended ? episode.actions[now] : null;
    const steering = action === 0 ? -1 : action === 2 ? 1 : 0;
    pen.save();
    pen.globalAlpha = car.alpha * (ghosts && look.ghosts && !mine && car.row < read ? 0.75 : 1);
    pen.translate(X(car.x), Y(car.y));
    pen.rotate(Math.atan2(car.vy, Math.max(Math.abs(car.vx), 1)));
    paintCar(pen, car, scale, wreck && mine ? color("--crash") : tintOf(episode, now, car, look.mode, read), {
      ink: color("--on-car"),
      label: mine ? "ego" : car.row < read ? car.row : "",
      braking: car.ax < -1,
      ring: mine,
      blink: steering && (look.calm || (t * 2.5) % 1 < 0.6) ? steering : 0,
    });
    pen.restore();
  }
  if (ghosts && (look.ghosts || look.masked)) {
    for (const ghost of ghosts) if (ghost.row || Math.hypot(ghost.dx, ghost.dy) > 0.4) paintGhost(pen, ghost, scale, X, Y, look.masked && !ended);
  }
  if (wreck) paintCrash(pen, X(ego.x), Y(ego.y), scale);
}

function paintCrash(pen, x, y, scale) {
  pen.save();
  pen.translate(x, y);
  pen.strokeStyle = color("--crash");
  pen.lineWidth = 2.5;
  pen.lineCap = "round";
  pen.beginPath();
  for (let ray = 0; ray < 12; ray++) {
    const angle = (ray * Math.PI) / 6 + 0.2, near = scale * 3.1, far = scale * (ray % 2 ? 4 : 4.7);
    pen.moveTo(Math.cos(angle) * near, Math.sin(angle) * near * 0.75);
    pen.lineTo(Math.cos(angle) * far, Math.sin(angle) * far * 0.75);
  }
  pen.stroke();
  pen.restore();
}

// Draw into a canvas as wide as it is shown, with as many pixels as the screen has.
function paintInto(canvas, episode, time, look) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth || 600, height = roadHeight(width, episode.lanes);
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) {
    [canvas.width, canvas.height] = [w, h];
    canvas.style.height = `${height}px`;
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  paintRoad(pen, width, episode, time, look);
}
