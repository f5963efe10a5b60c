// Makes the page alive: whatever is missing here, or refused by the browser, leaves its pictures.
"use strict";

let shownField;

function fillControls() {
  const select = document.querySelector("#field");
  const names = [...new Set([...fields.values()].map((field) => field.name))];
  if (select.options.length !== names.length)
    select.replaceChildren(...names.map((name) => new Option(name, name)));
  if (!names.includes(shownField)) shownField = names[0];
  select.value = shownField;
  select.parentElement.hidden = names.length < 2;
}

function showField() {
  for (const viewer of viewers) if (fields.has(`${viewer.of} density`)) viewer.show(shownField);
  drawSlices(shownField);
}

function listenToControls() {
  document.querySelector("#field").addEventListener("change", (event) => {
    shownField = event.target.value;
    sight.palette = shownField === "density" ? sight.palette : 1;
    document.querySelector("#palette").value = sight.palette;
    showField();
  });
  for (const name of ["opacity", "low", "high", "palette"]) {
    const input = document.querySelector(`#${name}`);
    input.value = name === "opacity" ? Math.log2(sight.opacity) : sight[name];
    input.addEventListener("input", () => {
      sight[name] = name === "opacity" ? 2 ** input.value : Number(input.value);
      redrawAll();
    });
  }
  for (const slider of document.querySelectorAll("figure.slice input"))
    slider.addEventListener("input", () => drawSlices(shownField));
}

async function makeAlive() {
  for (const pair of document.querySelectorAll(".pair")) makeWiper(pair);
  const room = document.querySelector("#viewers");
  if (!room || !window.DecompressionStream || !(await readFields())) return;
  const kinds = [...new Set([...fields.values()].map((field) => field.of))];
  document.body.classList.add("alive");
  shownField = room.dataset.shown;
  sight.palette = shownField === "density" ? 0 : 1;
  lookFrom(room.dataset.eye, Number(room.dataset.up));
  for (const kind of kinds) {
    const figure = document.createElement("figure");
    const canvas = document.createElement("canvas");
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    canvas.setAttribute("aria-roledescription", "volume");
    const caption = document.createElement("figcaption");
    caption.textContent = kind === "truth" ? "in the scene file" : "reconstructed";
    canvas.setAttribute("aria-label", `${caption.textContent}: arrow keys turn, + and - zoom`);
    figure.append(canvas, ...(kinds.length > 1 ? [caption] : []));
    room.append(figure);
    try {
      new Viewer(canvas, kind, Number(room.dataset.up));
    } catch (error) {
      figure.remove();
      document.body.classList.add("flat"); // no WebGL 2: pictures stay
      console.warn(error);
    }
  }
  fillControls();
  listenToControls();
  showField();
}

makeAlive();
