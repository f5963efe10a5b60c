// A page that a run serves while it goes on asks for itself again, and takes up what is new: the
// volume turns on as it stands, and views that have not changed keep their wipers.
"use strict";

const PAUSE = 2000; // milliseconds
let answered = new Date();
const taken = new Map(); // what each part was when it was last taken

function takePart(next, id) {
  const [part, here] = [next.getElementById(id), document.getElementById(id)];
  if (!part || taken.get(id) === part.outerHTML) return;
  taken.set(id, part.outerHTML);
  const fresh = document.importNode(part, true);
  if (here) here.replaceWith(fresh);
  else document.body.append(fresh);
  for (const pair of fresh.querySelectorAll(".pair")) makeWiper(pair);
  for (const film of fresh.querySelectorAll(".film")) makeFilm(film);
}

async function takeVolume(next) {
  const text = [...next.querySelectorAll("script.field")].map((field) => field.textContent).join();
  if (!viewers.length || taken.get("fields") === text) return;
  taken.set("fields", text);
  await readFields(next);
  fillControls();
  showField();
}

// Nobody answers any more: says so, and since when.
function tellLost(isLost) {
  const note = document.querySelector("#lost") ?? document.createElement("p");
  note.id = "lost";
  note.className = "doubts";
  note.hidden = !isLost;
  note.textContent =
    `No answer since ${answered.toLocaleTimeString()}: the run has ended or was stopped, or this page ` +
    "is no longer served. A finished run has its report.html; ddrecon watch serves the page again.";
  document.querySelector("#lead").after(note);
}

async function refresh() {
  try {
    const answer = await fetch(location.href, { cache: "no-store" });
    const next = new DOMParser().parseFromString(await answer.text(), "text/html");
    if (!("live" in next.body.dataset)) return location.reload(); // the run is done
    if (!document.querySelector("#viewers") && next.querySelector("#viewers")) return location.reload();
    for (const id of ["lead", "loss", "views", "quality", "frames"]) takePart(next, id);
    await takeVolume(next);
    answered = new Date();
    tellLost(false);
  } catch (error) {
    console.warn(error);
    tellLost(true);
  }
  setTimeout(refresh, PAUSE);
}

if ("live" in document.body.dataset) setTimeout(refresh, PAUSE);
