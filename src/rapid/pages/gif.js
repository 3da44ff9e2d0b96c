// A GIF of moving pictures, made here: nothing is asked of anybody. The format is GIF89a (W3C copy of CompuServe, 1990).

// At most 255 colours, the ones that occur most, from 15-bit ones; the last place of the table stands for "as before".
function paletteOf(pictures) {
  const counts = new Uint32Array(32768);
  for (const pixels of pictures) {
    for (let i = 0; i < pixels.length; i += 4) counts[((pixels[i] >> 3) << 10) | ((pixels[i + 1] >> 3) << 5) | (pixels[i + 2] >> 3)]++;
  }
  const used = [...counts.keys()].filter((key) => counts[key]).sort((a, b) => counts[b] - counts[a]).slice(0, 255);
  const widen = (five) => (five << 3) | (five >> 2);
  return used.map((key) => [widen(key >> 10), widen((key >> 5) & 31), widen(key & 31)]);
}

function nearestOf(palette) {
  const known = new Int16Array(32768).fill(-1);
  return (r, g, b) => {
    const key = ((r >> 3) << 10) | ((g >> 3) << 5) | (b >> 3);
    if (known[key] >= 0) return known[key];
    let best = 0, least = Infinity;
    palette.forEach(([pr, pg, pb], i) => {
      const far = (r - pr) ** 2 * 2 + (g - pg) ** 2 * 4 + (b - pb) ** 2 * 3;
      if (far < least) [best, least] = [i, far];
    });
    return (known[key] = best);
  };
}

// Lempel, Ziv and Welch's code of 8-bit indices, in blocks of at most 255 bytes.
function compress(indices, out) {
  const CLEAR = 256, END = 257;
  let codes = new Map(), next = 258, size = 9, buffer = 0, bits = 0, block = [];
  const flush = () => {
    if (block.length) out.push(block.length, ...block);
    block = [];
  };
  const emit = (code) => {
    buffer |= code << bits;
    bits += size;
    while (bits >= 8) {
      block.push(buffer & 255);
      if (block.length === 255) flush();
      buffer >>>= 8;
      bits -= 8;
    }
  };
  out.push(8);
  emit(CLEAR);
  let prefix = indices[0];
  for (let i = 1; i < indices.length; i++) {
    const key = (prefix << 8) | indices[i], code = codes.get(key);
    if (code !== undefined) {
      prefix = code;
      continue;
    }
    emit(prefix);
    if (next < 4096) {
      if (next === 1 << size) size++;
      codes.set(key, next++);
    } else {
      emit(CLEAR);
      [codes, next, size] = [new Map(), 258, 9];
    }
    prefix = indices[i];
  }
  emit(prefix);
  emit(END);
  if (bits) block.push(buffer & 255);
  flush();
  out.push(0);
}

// Return a GIF of `count` pictures, each drawn by draw(index) on the canvas, `delay` hundredths of a second apart.
async function makeGif(canvas, count, delay, draw, progress) {
  const pen = canvas.getContext("2d", { willReadFrequently: true }), { width, height } = canvas;
  const pixelsOf = (index) => {
    draw(index);
    return pen.getImageData(0, 0, width, height).data;
  };
  const sampled = [0, 0.25, 0.5, 0.75, 1].map((share) => pixelsOf(Math.round(share * (count - 1))));
  const palette = paletteOf(sampled), nearest = nearestOf(palette), SAME = 255, chunks = [];
  const word = (value) => [value & 255, value >> 8];
  const table = [...palette, ...Array(256 - palette.length).fill([0, 0, 0])].flat();
  chunks.push(Uint8Array.from([..."GIF89a"].map((c) => c.charCodeAt(0))), Uint8Array.from([...word(width), ...word(height), 0xf7, 0, 0, ...table]));
  chunks.push(Uint8Array.from([0x21, 0xff, 11, ...[..."NETSCAPE2.0"].map((c) => c.charCodeAt(0)), 3, 1, 0, 0, 0]));
  let before = null;
  for (let n = 0; n < count; n++) {
    const pixels = pixelsOf(n), whole = new Uint8Array(width * height), indices = new Uint8Array(width * height);
    for (let i = 0, p = 0; i < whole.length; i++, p += 4) {
      whole[i] = nearest(pixels[p], pixels[p + 1], pixels[p + 2]);
      indices[i] = before && before[i] === whole[i] ? SAME : whole[i];
    }
    before = whole;
    const out = [0x21, 0xf9, 4, 0x05, ...word(delay), SAME, 0, 0x2c, 0, 0, 0, 0, ...word(width), ...word(height), 0];
    compress(indices, out);
    chunks.push(Uint8Array.from(out));
    progress((n + 1) / count);
    // Between two pictures the page may do something else.
    await new Promise((done) => setTimeout(done));
  }
  chunks.push(Uint8Array.from([0x3b]));
  return new Blob(chunks, { type: "image/gif" });
}
