// Target and render of a view in one frame: a wiper between them, their difference, and what is in
// a pixel.
"use strict";

const ENLARGED = 4; // differences of displayed values, around gray

function readPixels(image) {
  const canvas = document.createElement("canvas");
  canvas.width = image.naturalWidth;
  canvas.height = image.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  return [context.getImageData(0, 0, canvas.width, canvas.height), context];
}

function differenceOf(target, render) {
  const [[before], [after, context]] = [target, render].map(readPixels);
  for (let i = 0; i < after.data.length; ++i)
    if (i % 4 !== 3) after.data[i] = 128 + ENLARGED * (after.data[i] - before.data[i]);
  context.putImageData(after, 0, 0);
  return context.canvas;
}

function makeWiper(pair) {
  const [target, render] = pair.querySelectorAll("img");
  const output = document.createElement("output");
  pair.append(output);
  let place, height, read;
  const wipe = (part, down) => {
    [place, height] = [part, down].map((share) => Math.min(1, Math.max(0, share)));
    pair.style.setProperty("--wiped", `${100 * place}%`);
    pair.setAttribute("aria-valuenow", Math.round(100 * place));
  };
  const tell = () => {
    read ??= [target, render].map((image) => readPixels(image)[0]);
    const [width, rows] = [read[0].width, read[0].height];
    const [x, y] = [Math.min(width - 1, Math.floor(place * width)), Math.min(rows - 1, Math.floor(height * rows))];
    const white = Number(pair.closest("section").querySelector("[data-white]").dataset.white);
    const texts = read.map(({ data }) => [0, 1, 2].map((i) => round(white * linear(data[4 * (y * width + x) + i] / 255))));
    output.textContent = `${x}, ${y}: ${texts[0].join(" ")} | ${texts[1].join(" ")}`;
    pair.setAttribute("aria-valuetext", output.textContent);
  };
  pair.classList.add("wiper");
  pair.tabIndex = 0;
  pair.setAttribute("role", "slider");
  pair.setAttribute("aria-label", `${target.alt} on the left, ${render.alt} on the right`);
  wipe(0.5, 0.5);
  const follow = (event) => {
    const { left, top, width, height } = pair.getBoundingClientRect();
    wipe((event.clientX - left) / width, (event.clientY - top) / height);
    tell();
  };
  pair.addEventListener("pointermove", follow);
  pair.addEventListener("pointerdown", follow);
  pair.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: [-0.05, 0], ArrowRight: [0.05, 0], ArrowUp: [0, -0.05], ArrowDown: [0, 0.05] };
    if (!(event.key in steps)) return;
    event.preventDefault();
    wipe(place + steps[event.key][0], height + steps[event.key][1]);
    tell();
  });
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "difference";
  pair.parentElement.querySelector("figcaption").append(" ", button);
  let difference;
  const reveal = (isShown) => {
    if (isShown && !difference) {
      difference = differenceOf(target, render);
      pair.append(difference);
    }
    pair.classList.toggle("differs", isShown);
  };
  let isKept = false;
  button.addEventListener("pointerenter", () => reveal(true));
  button.addEventListener("pointerleave", () => reveal(isKept));
  button.addEventListener("click", () => {
    isKept = !isKept;
    button.setAttribute("aria-pressed", isKept);
    reveal(isKept);
  });
}

// Brightens and darkens all pictures, in linear light, by stops.
function makeExposure() {
  const slider = document.querySelector(".exposure input");
  slider?.addEventListener("input", () => {
    for (const part of document.querySelector("#exposure").children) part.setAttribute("slope", 2 ** slider.value);
    slider.nextElementSibling.textContent = `${slider.value} stops`;
    slider.setAttribute("aria-valuetext", slider.nextElementSibling.textContent);
  });
}
