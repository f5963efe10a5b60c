// A film, one frame at a time: its pictures and its volume, by a slider or played.
"use strict";

function makeFilm() {
  const control = document.querySelector("#film");
  if (!control) return;
  const numbers = JSON.parse(control.dataset.frames);
  const [button, slider] = control.children;
  const output = control.querySelector("output");
  slider.max = numbers.length - 1;
  const show = () => {
    const at = Number(slider.value);
    for (const film of document.querySelectorAll(".film"))
      [...film.children].forEach((figure, index) => (figure.hidden = index !== at));
    output.textContent = `frame ${numbers[at]}`;
    slider.setAttribute("aria-valuetext", output.textContent);
    chooseFrame(numbers[at]);
    if (shownField) showField();
  };
  let timer;
  const play = (isPlayed) => {
    clearInterval(timer);
    timer = isPlayed && setInterval(() => {
      slider.value = (Number(slider.value) + 1) % numbers.length;
      show();
    }, Math.max(40, 4000 / numbers.length));
    button.setAttribute("aria-pressed", Boolean(isPlayed));
  };
  button.addEventListener("click", () => play(!timer));
  slider.addEventListener("input", () => (play(false), show()));
  control.hidden = false;
  show();
}
