// Slices of the volumes across x, y and z, each with a slider; they meet in a cell, which is read out.
"use strict";

// How a slice across `axis` lies: which axis runs to the right and which upwards.
const SIDES = [[2, 1], [0, 2], [0, 1]];

const slider = (axis) => document.querySelector(`figure.slice[data-axis="${axis}"] input`);

function drawSlice(canvas, field, axis, cut) {
  const [across, upwards] = SIDES[axis];
  const [width, height] = [field.size[across], field.size[upwards]];
  canvas.width = width;
  canvas.height = height;
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  const cell = [...cut];
  for (let row = 0; row < height; ++row) {
    cell[upwards] = height - 1 - row;
    for (let column = 0; column < width; ++column) {
      cell[across] = column;
      const isCut = column === cut[across] || cell[upwards] === cut[upwards];
      for (let channel = 0; channel < 3; ++channel) {
        const value = displayed(field, ...cell, field.channels === 3 ? channel : 0);
        image.data[(row * width + column) * 4 + channel] = 255 * (isCut ? 0.7 * value + 0.2 : value);
      }
      image.data[(row * width + column) * 4 + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
  canvas.style.aspectRatio = `${world.sides[across]} / ${world.sides[upwards]}`;
}

// Draws every slice of the page, of the field `name`, and says what is in the cell where they meet.
function drawSlices(name) {
  const { size, signed, white } = fields.get(`result ${name}`);
  const cut = size.map((count, axis) => Math.min(count - 1, Math.floor(slider(axis).value * count)));
  const at = cut.map((index, i) => round(world.low[i] + ((index + 0.5) / size[i]) * world.sides[i]));
  const readings = [];
  for (const figure of document.querySelectorAll("figure.slice")) {
    const axis = Number(figure.dataset.axis);
    const count = size[axis];
    Object.assign(slider(axis), { min: 0.5 / count, max: 1 - 0.5 / count, step: 1 / count }); // by cells
    for (const canvas of figure.querySelectorAll("canvas")) {
      const field = fields.get(`${canvas.dataset.of} ${name}`);
      canvas.hidden = !field;
      if (!field) continue;
      drawSlice(canvas, field, axis, cut);
      if (axis === 0) readings.push(valueOf(field, ...cut).map(round).join(", "));
    }
    const [across, upwards] = SIDES[axis].map((i) => `${"xyz"[i]} ${round(world.sides[i])}`);
    const place = `${"xyz"[axis]} = ${at[axis]}: cell ${cut[axis]} of ${count}`;
    figure.querySelector("output").textContent = `${place}; ${across} to the right, ${upwards} up`;
    slider(axis).setAttribute("aria-valuetext", place);
  }
  document.querySelector("#cell").textContent =
    `${name} at ${at.join(", ")}: ${readings.join("; in the scene file ")}`;
  // The scale of the slices, and that of the viewer's colors for values.
  document.querySelector("#scale").className = signed ? "signed" : "";
  EVEN.forEach((part, i) => (document.querySelectorAll("#scale span")[i].textContent =
    round(white * (signed ? 2 * part - 1 : linear(part)))));
}

// A touch of a slice moves the other two to where it is.
function listenToSlices() {
  for (const canvas of document.querySelectorAll("figure.slice canvas")) {
    const axes = SIDES[canvas.closest("figure").dataset.axis];
    const follow = (event) => {
      if (!event.buttons) return;
      const { left, bottom, width, height } = canvas.getBoundingClientRect();
      const shares = [(event.clientX - left) / width, (bottom - event.clientY) / height];
      axes.forEach((axis, i) => (slider(axis).value = Math.min(1, Math.max(0, shares[i]))));
      drawSlices(shownField);
    };
    for (const kind of ["pointerdown", "pointermove"]) canvas.addEventListener(kind, follow);
  }
  for (const axis of [0, 1, 2]) slider(axis).addEventListener("input", () => drawSlices(shownField));
}
