// The volumes of a page: 8-bit numbers, compressed and in base64, in elements
// <script type="application/json" class="field">. Numbers are stored as they are displayed (sRGB),
// so that a thin haze is not lost.
"use strict";

const fields = new Map(); // "result density" -> {name, of, size, box, white, channels, bytes}

async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Response(packed).body.pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Reads every field of the page anew; resolves to whether there are any.
async function readFields(page = document) {
  const found = [...page.querySelectorAll("script.field")];
  const read = await Promise.all(
    found.map(async (element) => {
      const field = JSON.parse(element.textContent);
      return { ...field, bytes: await unpack(field.data), data: undefined };
    }),
  );
  fields.clear();
  for (const field of read) fields.set(`${field.of} ${field.name}`, field);
  return read.length > 0;
}

// The number of a cell (x, y, z), as it is displayed, in [0, 1]; of its first channel, or another.
function displayed(field, x, y, z, channel = 0) {
  const [nx, ny] = field.size;
  return field.bytes[((z * ny + y) * nx + x) * field.channels + channel] / 255;
}
