// The pictures of a film, one at a time, with a slider that goes from frame to frame.
"use strict";

function makeFilm(film) {
  const figures = [...film.querySelectorAll("figure")];
  const slider = document.createElement("input");
  slider.type = "range";
  slider.max = figures.length - 1;
  slider.value = 0;
  slider.setAttribute("aria-label", "frame");
  const show = () => figures.forEach((figure, at) => (figure.hidden = at !== Number(slider.value)));
  slider.addEventListener("input", show);
  film.prepend(slider);
  show();
}

for (const film of document.querySelectorAll(".film")) makeFilm(film);
