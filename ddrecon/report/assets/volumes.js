// The volumes of a page: 8-bit numbers, compressed and in base64, in elements
// <script type="application/json" class="field">. Numbers are stored as they are displayed (sRGB),
// so that a thin haze is not lost.
"use strict";

const fields = new Map(); // "result density" -> {name, of, frame, size, white, signed, channels, bytes}
let everyField = []; // of all frames

async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Response(packed).body.pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Reads every field of the page; resolves to whether there are any.
async function readFields() {
  const elements = [...document.querySelectorAll("script.field")];
  everyField = await Promise.all(
    elements.map(async (element) => {
      const field = JSON.parse(element.textContent);
      return { ...field, bytes: await unpack(field.data), data: undefined };
    }),
  );
  chooseFrame(everyField[0]?.frame);
  return everyField.length > 0;
}

// Has `fields` be those of a frame of a film, or those of a run, where `frame` is null.
function chooseFrame(frame) {
  for (const field of everyField)
    if (field.frame === frame) fields.set(`${field.of} ${field.name}`, field);
}

// The number of a cell (x, y, z), as it is displayed, in [0, 1]; of its first channel, or another.
function displayed(field, x, y, z, channel = 0) {
  const [nx, ny] = field.size;
  return field.bytes[((z * ny + y) * nx + x) * field.channels + channel] / 255;
}

const linear = (shown) => (shown <= 0.04045 ? shown / 12.92 : ((shown + 0.055) / 1.055) ** 2.4);
const EVEN = [0, 1, 2, 3, 4].map((part) => part / 4);

// The number of a cell, or its three. Signed ones are blue below 0 and red above, by one channel.
function valueOf(field, ...cell) {
  const values = Array.from({ length: field.channels }, (_, channel) => displayed(field, ...cell, channel));
  if (!field.signed) return values.map((value) => field.white * linear(value));
  const [red, green, blue] = values;
  return [field.white * (red < blue ? (green - 1) / 0.7 : (1 - green) / 0.91)];
}
