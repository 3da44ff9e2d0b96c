// A moment to keep or to give away: as a link, a picture, or a few seconds that move.

const AROUND = 4, GIF_WIDTH = 720, PICTURE_WIDTH = 1200, FRAMES = 12.5;

// Draw all roads of the player, one under the other with their names, as one picture `width` wide.
function compose(pen, player, width, time) {
  let y = 0;
  for (const episode of player.episodes) {
    const t = Math.min(time, lengthOf(episode)), ended = t >= lengthOf(episode) && episode.ended !== false;
    pen.save();
    pen.translate(0, y);
    pen.fillStyle = color("--card");
    pen.fillRect(0, 0, width, 30);
    pen.font = "600 13px system-ui, sans-serif";
    pen.textBaseline = "middle";
    pen.textAlign = "left";
    pen.fillStyle = color("--ink");
    const under = episode.attack && episode.attack !== "none" ? ` under ${episode.attack}` : "";
    pen.fillText(`${episode.agent}${under}`, 10, 15, width * 0.6);
    pen.textAlign = "right";
    pen.fillStyle = color(ended && episode.crashed ? "--crash" : "--soft");
    pen.fillText(`${ended && episode.crashed ? "crashed, " : ""}return ${earned(episode, t).toFixed(1)}, second ${t.toFixed(0)}`, width - 10, 15);
    pen.translate(0, 30);
    pen.beginPath();
    pen.rect(0, 0, width, roadHeight(width, episode.lanes));
    pen.clip();
    paintRoad(pen, width, episode, t, { ...player.look, masked: false, calm: false });
    pen.restore();
    y += 30 + roadHeight(width, episode.lanes);
  }
}
function sheet(player, width, ratio = 1) {
  const height = player.episodes.reduce((sum, episode) => sum + 30 + roadHeight(width, episode.lanes), 0);
  const canvas = element("canvas");
  // A movie's sides are even numbers.
  [canvas.width, canvas.height] = [2 * Math.round((width * ratio) / 2), 2 * Math.round((height * ratio) / 2)];
  const pen = canvas.getContext("2d", { willReadFrequently: ratio === 1 });
  pen.scale(ratio, ratio);
  return { canvas, draw: (time) => compose(pen, player, width, time) };
}

function addSharing(player, options) {
  const note = element("output", { class: "note", "aria-live": "polite" });
  const span = chooser("how much of it", [["around", `${2 * AROUND} seconds around this moment`], ["whole", "the whole episode"]]);
  const save = (blob, ending) => {
    const url = URL.createObjectURL(blob), name = `rapid-${Math.round(player.time)}s.${ending}`;
    const link = element("a", { href: url, download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(url), 60_000);
    note.value = `${name}: ${Math.max(1, Math.round(blob.size / 1024))} kB`;
  };
  const range = () => {
    const end = Math.max(...player.episodes.map(lengthOf));
    if (span.value === "whole") return [0, end];
    const from = clamp(player.time - AROUND, 0, Math.max(end - 2 * AROUND, 0));
    return [from, Math.min(from + 2 * AROUND, end)];
  };
  // One thing at a time, with the player at rest; whatever goes wrong is said where it was asked for.
  let busy = false;
  const making = (words, make) => async () => {
    if (busy || !player.episodes.length) return;
    busy = true;
    player.setRunning(false);
    note.value = `${words} …`;
    try {
      await make();
    } catch (error) {
      note.value = `This browser could not do it: ${error.message}`;
    }
    busy = false;
  };
  const percent = (words) => (share) => (note.value = `${words} … ${Math.round(100 * share)} %`);

  async function copyLink() {
    const link = options.link();
    try {
      await navigator.clipboard.writeText(link);
      note.value = "The link to this moment was copied.";
    } catch {
      // Without the right to the clipboard the link is shown, to be copied by hand.
      const field = element("input", { readonly: "", value: link, "aria-label": "link to this moment" });
      note.replaceChildren(field);
      field.select();
    }
  }
  async function picture() {
    const { canvas, draw } = sheet(player, PICTURE_WIDTH, 2);
    draw(player.time);
    save(await new Promise((done) => canvas.toBlob(done, "image/png")), "png");
  }
  async function gif() {
    const { canvas, draw } = sheet(player, GIF_WIDTH), [from, to] = range();
    const speed = span.value === "whole" ? 2 : 1, count = Math.max(2, Math.round(((to - from) / speed) * FRAMES) + 1);
    save(await makeGif(canvas, count, 100 / FRAMES, (n) => draw(from + ((to - from) * n) / (count - 1)), percent("GIF")), "gif");
  }
  async function movie() {
    const type = ["video/mp4;codecs=avc1.42E01F", "video/mp4", "video/webm;codecs=vp9", "video/webm"].find((t) => MediaRecorder.isTypeSupported(t));
    if (!type) throw new Error("it records no movies");
    const { canvas, draw } = sheet(player, PICTURE_WIDTH, 1), [from, to] = range(), speed = span.value === "whole" ? 2 : 1;
    draw(from);
    const recorder = new MediaRecorder(canvas.captureStream(30), { mimeType: type, videoBitsPerSecond: 6e6 }), parts = [];
    recorder.ondataavailable = (event) => parts.push(event.data);
    const stopped = new Promise((done) => (recorder.onstop = done));
    recorder.start();
    // It is recorded while it plays, so it takes as long as it lasts.
    const began = performance.now();
    await new Promise((done) => {
      const frame = () => {
        const t = from + (Math.max(performance.now() - began, 0) / 1000) * speed;
        draw(Math.min(t, to));
        percent("movie")(clamp((t - from) / (to - from), 0, 1));
        t < to + 0.6 * speed ? requestAnimationFrame(frame) : done();
      };
      requestAnimationFrame(frame);
    });
    recorder.stop();
    await stopped;
    save(new Blob(parts, { type }), type.startsWith("video/mp4") ? "mp4" : "webm");
  }
  player.root.append(
    element(
      "div", { class: "controls sharing", role: "group", "aria-label": "share this moment" },
      ...(options.link ? [button("Copy link", {}, making("link", copyLink))] : []), button("PNG", {}, making("picture", picture)),
      button("GIF", {}, making("GIF", gif)), button("Movie", {}, making("movie", movie)), span, note,
    ),
  );
}
