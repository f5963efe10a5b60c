// What stands around a volume, in boxes from its middle: the box with its axes, and cameras as
// frusta with their pictures. Behind the smoke on one canvas, before it on another.
"use strict";

const world = {}; // up, eye, light, low, sides, cameras: as ddrecon says
const CAMERA = "#ffd479";
const AXES = ["#ff7b6b", "#7fd67f", "#7fb2ff"];
const EDGES = [0, 1, 2].flatMap((axis) => [0, 1, 2, 3].map((place) => {
  const ends = [[0, 0, 0], [0, 0, 0]];
  for (const end of ends) [end[(axis + 1) % 3], end[(axis + 2) % 3]] = [place & 1, place >> 1];
  ends[1][axis] = 1;
  return { axis, ends, isFirst: place === 0 };
}));

const dot = (a, b) => a.reduce((sum, part, axis) => sum + part * b[axis], 0);
const pictureOf = (name) =>
  [...document.querySelectorAll(".pair img")].find((image) => image.alt.startsWith(`${name}: `));

// Draws it for an eye with its axes; `tangent` is that of half the height of view.
function drawAround(layers, { eye, right, up, forward }, tangent) {
  const { clientWidth: width, clientHeight: height } = layers[0];
  const contexts = layers.map((canvas) => {
    [canvas.width, canvas.height] = [width, height].map((side) => side * devicePixelRatio);
    const context = canvas.getContext("2d");
    context.scale(devicePixelRatio, devicePixelRatio);
    context.font = "12px system-ui, sans-serif";
    return context;
  });
  const place = (point) => { // to the right, down, and away from the eye
    const away = point.map((part, axis) => part - eye[axis]);
    const depth = dot(away, forward);
    const scale = height / 2 / tangent / Math.max(depth, 1e-6);
    return [width / 2 + dot(away, right) * scale, height / 2 - dot(away, up) * scale, depth];
  };
  // Draws `points` as a line of a `color`, with a `text` at its end, or an `image` between them.
  const draw = (points, color, text = "", image = undefined) => {
    if (points.some(([, , depth]) => depth < 0.02)) return;
    const depth = points.reduce((sum, point) => sum + point[2] / points.length, 0);
    const context = contexts[depth > Math.hypot(...eye) ? 0 : 1];
    if (image) {
      const [[x, y], [rightX, rightY], , [downX, downY]] = points;
      context.save();
      context.transform(rightX - x, rightY - y, downX - x, downY - y, x, y);
      context.drawImage(image, 0, 0, 1, 1);
      context.restore();
    }
    [context.strokeStyle, context.fillStyle] = [color, color];
    context.beginPath();
    for (const point of points) context.lineTo(point[0], point[1]);
    context.stroke();
    context.fillText(text, points.at(-1)[0] + 4, points.at(-1)[1] + 12);
  };
  const longest = Math.max(...world.sides);
  for (const { axis, ends, isFirst } of EDGES) {
    const corners = ends.map((end) => end.map((part, i) => ((part - 0.5) * world.sides[i]) / longest));
    const text = isFirst ? `${"xyz"[axis]} ${round(world.low[axis] + world.sides[axis])}` : "";
    draw(corners.map(place), isFirst ? AXES[axis] : "#fff5", text);
    if (isFirst && axis === 0) draw([place(corners[0])], "#fffb", world.low.map(round).join(", "));
  }
  for (const { name, corners } of sight.cameras ? world.cameras : []) {
    const aside = dot(corners[0], eye) / Math.hypot(...corners[0]) / Math.hypot(...eye);
    if (aside > 0.97) continue; // it would stand in the way
    const [from, ...ends] = corners.map(place);
    draw(ends, CAMERA, "", pictureOf(name));
    for (const end of ends) draw([from, end], CAMERA);
    draw([ends[0], ends[3]], CAMERA, name);
  }
}

// `number` with as many digits as one reads.
function round(number) {
  return String(Number(number.toPrecision(3)));
}
