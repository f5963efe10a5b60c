// Target and render of a view in one frame: a wiper between them, and their difference.
"use strict";

const ENLARGED = 4; // differences of displayed values, around gray

function differenceOf(target, render) {
  const canvas = document.createElement("canvas");
  canvas.width = target.naturalWidth;
  canvas.height = target.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const [before, after] = [target, render].map((image) => {
    context.drawImage(image, 0, 0);
    return context.getImageData(0, 0, canvas.width, canvas.height);
  });
  for (let i = 0; i < after.data.length; ++i)
    if (i % 4 !== 3) after.data[i] = 128 + ENLARGED * (after.data[i] - before.data[i]);
  context.putImageData(after, 0, 0);
  return canvas;
}

function makeWiper(pair) {
  const [target, render] = pair.querySelectorAll("img");
  let place;
  const wipe = (part) => {
    place = Math.min(1, Math.max(0, part));
    pair.style.setProperty("--wiped", `${100 * place}%`);
    pair.setAttribute("aria-valuenow", Math.round(100 * place));
  };
  pair.classList.add("wiper");
  pair.tabIndex = 0;
  pair.setAttribute("role", "slider");
  pair.setAttribute("aria-label", `${target.alt} on the left, ${render.alt} on the right`);
  wipe(0.5);
  const follow = (event) => {
    const { left, width } = pair.getBoundingClientRect();
    wipe((event.clientX - left) / width);
  };
  pair.addEventListener("pointermove", follow);
  pair.addEventListener("pointerdown", follow);
  pair.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.05, ArrowRight: 0.05 }[event.key];
    if (!step) return;
    event.preventDefault();
    wipe(place + step);
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
