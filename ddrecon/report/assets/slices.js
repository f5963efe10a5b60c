// Slices of the volumes across x, y and z, each with a slider.
"use strict";

// How a slice across `axis` lies: which axis runs to the right and which upwards.
const SIDES = [[2, 1], [0, 2], [0, 1]];

function drawSlice(canvas, field, axis, part) {
  const [across, upwards] = SIDES[axis];
  const [width, height] = [field.size[across], field.size[upwards]];
  canvas.width = width;
  canvas.height = height;
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  const cell = [0, 0, 0];
  cell[axis] = Math.min(field.size[axis] - 1, Math.floor(part * field.size[axis]));
  for (let row = 0; row < height; ++row) {
    cell[upwards] = height - 1 - row;
    for (let column = 0; column < width; ++column) {
      cell[across] = column;
      for (let channel = 0; channel < 3; ++channel) {
        const value = displayed(field, ...cell, field.channels === 3 ? channel : 0);
        image.data[(row * width + column) * 4 + channel] = 255 * value;
      }
      image.data[(row * width + column) * 4 + 3] = 255;
    }
  }
  context.putImageData(image, 0, 0);
  canvas.style.aspectRatio = `${field.box[across]} / ${field.box[upwards]}`;
}

// Draws every slice of the page, of the field `name`; `axes` holds the places of the sliders.
function drawSlices(name) {
  for (const figure of document.querySelectorAll("figure.slice")) {
    const axis = Number(figure.dataset.axis);
    const slider = figure.querySelector("input");
    const count = fields.get(`result ${name}`).size[axis];
    Object.assign(slider, { min: 0.5 / count, max: 1 - 0.5 / count, step: 1 / count }); // by cells
    const part = Number(slider.value);
    for (const canvas of figure.querySelectorAll("canvas")) {
      const field = fields.get(`${canvas.dataset.of} ${name}`);
      canvas.hidden = !field;
      if (field) drawSlice(canvas, field, axis, part);
    }
    const place = `${"xyz"[axis]}: cell ${Math.floor(part * count)} of ${count}`;
    figure.querySelector("output").textContent = place;
    slider.setAttribute("aria-valuetext", place);
  }
}
