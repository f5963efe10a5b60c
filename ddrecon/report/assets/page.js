// Makes the page alive: whatever is missing here, or refused by the browser, leaves its pictures.
"use strict";

let shownField;

function showField() {
  for (const viewer of viewers) if (fields.has(`${viewer.of} density`)) viewer.show(shownField);
  drawSlices(shownField);
}

function listenToControls() {
  const select = document.querySelector("#field");
  const names = [...new Set([...fields.values()].map((field) => field.name))];
  if (!names.includes(shownField)) shownField = names[0];
  select.append(...names.map((name) => new Option(name, name, false, name === shownField)));
  select.parentElement.hidden = names.length < 2;
  select.addEventListener("change", () => {
    shownField = select.value;
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
  document.querySelector("#from")?.addEventListener("change", (event) => {
    lookFrom(world.cameras[event.target.value].corners[0]);
    redrawAll();
  });
  document.querySelector("#cameras")?.addEventListener("change", (event) => {
    sight.cameras = event.target.checked;
    redrawAll();
  });
  listenToSlices();
}

async function makeAlive() {
  for (const pair of document.querySelectorAll(".pair")) makeWiper(pair);
  makeExposure();
  makeFilm();
  const room = document.querySelector("#viewers");
  if (!room || !window.DecompressionStream || !(await readFields())) return;
  const kinds = [...new Set([...fields.values()].map((field) => field.of))];
  document.body.classList.add("alive");
  shownField = room.dataset.shown;
  sight.palette = shownField === "density" ? 0 : 1;
  Object.assign(world, JSON.parse(document.querySelector("#world").textContent));
  lookFrom(world.eye);
  for (const kind of kinds) {
    const figure = document.createElement("figure");
    const [behind, canvas, before] = [0, 1, 2].map(() => document.createElement("canvas"));
    const stage = document.createElement("div");
    stage.className = "stage";
    stage.append(behind, canvas, before);
    behind.ariaHidden = before.ariaHidden = "true";
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "application");
    canvas.setAttribute("aria-roledescription", "volume");
    const caption = document.createElement("figcaption");
    caption.textContent = kind === "truth" ? "in the scene file" : "reconstructed";
    canvas.setAttribute("aria-label", `${caption.textContent}: arrow keys turn, + and - zoom`);
    figure.append(stage, ...(kinds.length > 1 ? [caption] : []));
    room.append(figure);
    try {
      new Viewer(canvas, kind, [behind, before]);
    } catch (error) {
      figure.remove();
      document.body.classList.add("flat"); // no WebGL 2: pictures stay
      console.warn(error);
    }
  }
  listenToControls();
  showField();
}

makeAlive();
