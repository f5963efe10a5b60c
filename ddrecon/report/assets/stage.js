// What stands around a volume, in boxes from its middle: the box with its axes, and cameras as
// frusta with their pictures. Behind the smoke on one canvas, before it on another.
"use strict";

const world = {}; // up, eye, light, low, sides, cameras: as ddrecon says
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
    context.font = "12px system-ui, sans-serif";
    return context;
  });
  const scale = height / 2 / tangent;
  const place = (point) => {
    const away = point.map((part, axis) => part - eye[axis]);
    const depth = dot(away, forward);
    const to = scale / Math.max(depth, 1e-6);
    return [width / 2 + dot(away, right) * to, height / 2 - dot(away, up) * to, depth];
  };
  const middle = Math.hypot(...eye);
  const pick = (points) => { // the canvas for these, at their place; none for what is behind the eye
    if (points.some((point) => point[2] < 0.02)) return undefined;
    const depth = points.reduce((sum, point) => sum + point[2] / points.length, 0);
    const context = contexts[depth > middle ? 0 : 1];
    context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    return context;
  };
  const draw = (points, color) => {
    const context = pick(points);
    if (!context) return;
    context.strokeStyle = color;
    context.beginPath();
    points.forEach(([x, y]) => context.lineTo(x, y));
    context.stroke();
  };
  const write = (text, point, color) => {
    const context = pick([point]);
    if (!context) return;
    context.fillStyle = color;
    context.fillText(text, point[0] + 4, point[1] + 12);
  };
  const longest = Math.max(...world.sides);
  for (const { axis, ends, isFirst } of EDGES) {
    const corners = ends.map((end) => end.map((part, i) => (part - 0.5) * world.sides[i] / longest));
    const points = corners.map(place);
    draw(points, isFirst ? AXES[axis] : "#fff5");
    if (isFirst) write(`${"xyz"[axis]} ${round(world.low[axis] + world.sides[axis])}`, points[1], AXES[axis]);
    if (isFirst && axis === 0) write(world.low.map(round).join(", "), points[0], "#fffb");
  }
  if (!sight.cameras) return;
  for (const { name, corners } of world.cameras) {
    const [from, ...ends] = corners.map(place);
    const context = pick([from, ...ends]);
    const image = pictureOf(name);
    if (context && image) {
      const [[x, y], [rightX, rightY], , [downX, downY]] = ends;
      context.save();
      context.transform(rightX - x, rightY - y, downX - x, downY - y, x, y);
      context.drawImage(image, 0, 0, 1, 1);
      context.restore();
    }
    ends.forEach((end, i) => draw([from, end, ends[(i + 1) % 4]], "#ffd479"));
    write(name, ends[3], "#ffd479");
  }
}

// `number` with as many digits as one reads.
function round(number) {
  return String(Number(number.toPrecision(3)));
}
