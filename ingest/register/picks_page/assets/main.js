// Picks in a photo and on a scan, and what they say at once.

import { Pane } from "./pane.js";

const $ = (id) => document.getElementById(id);
const picture = (url) => new Promise((done, failed) => {
  const image = new Image();
  image.onload = () => done(image);
  image.onerror = () => failed(new Error(`no picture at ${url}`));
  image.src = url;
});

// One pick is {photo: [x, y] | null, ground: [x, y] | null}; what the server says of the whole ones lies in `told`.
let state, photo, picks = [], told = { picks: [] }, turn = 0, busy = false, refined = false;

const whole = () => picks.filter((p) => p.photo && p.ground);

async function ask(path, body) {
  const options = body && { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  const answer = await fetch(`api/${path}`, options);
  const json = await answer.json();
  if (!answer.ok) throw new Error(json.message || `the program answered ${answer.status}`);
  return json;
}

const body = () => ({
  image: photo.id,
  picks: whole().map((p) => ({ x: p.photo[0], y: p.photo[1], ground_x: p.ground[0], ground_y: p.ground[1] })),
});

function pane(canvas, side) {
  return new Pane(canvas, {
    marks: () => picks.flatMap((p, row) => {
      if (!p[side]) return [];
      const said = told.picks[whole().indexOf(p)];
      const state = !p.photo || !p.ground ? "half" : said && (said.wrong || said.doubtful) ? "wrong" : "good";
      return [{ x: p[side][0], y: p[side][1], row, state, to: side === "photo" && said ? said.at : null }];
    }),
    pick(x, y) {
      if (busy) return;
      const open = picks.find((p) => !p[side]);
      if (open) open[side] = [x, y];
      else if (picks.length && !(picks.at(-1).photo && picks.at(-1).ground)) picks.at(-1)[side] = [x, y];
      else picks.push({ photo: null, ground: null, [side]: [x, y] });
      changed();
    },
    move(row, x, y, settled) {
      if (busy) return;
      picks[row][side] = [x, y];
      if (settled) changed();
    },
  });
}

const panes = { photo: pane($("photo"), "photo"), ground: pane($("ground"), "ground") };

function draw() {
  panes.photo.draw();
  panes.ground.draw();
  const missing = Math.max(0, photo.least - whole().length);
  const half = picks.find((p) => !p.photo || !p.ground);
  $("hint").textContent = half ? `Now click the same spot in the ${half.photo ? "scan" : "photo"}.`
    : missing ? `Click a spot in the photo, then the same spot in the scan: ${missing} more ${missing > 1 ? "are" : "is"} needed. Corners of roofs, markings and walls are best, spread over the photo. Wheel zooms, dragging moves.`
    : "Drag a mark to move it, or add more. When the edges lie on the photo: Refine.";
  $("rows").replaceChildren(...picks.map((p, row) => {
    const said = told.picks[whole().indexOf(p)], line = document.createElement("tr");
    line.className = said && said.wrong ? "wrong" : said && said.doubtful ? "doubtful" : "";
    const number = Object.assign(document.createElement("span"), { className: "number", textContent: row + 1 });
    const remove = Object.assign(document.createElement("button"), { textContent: "\u00d7", title: "Remove this pick" });
    remove.setAttribute("aria-label", `Remove pick ${row + 1}`);
    remove.onclick = () => { if (!busy) { picks.splice(row, 1); changed(); } };
    const words = !said ? "" : said.wrong ? "wrong" : said.doubtful ? "perhaps wrong" : `${said.sigmas.toFixed(1)} \u03c3`;
    for (const inside of [number, said ? `${said.residual_px.toFixed(1)} px` : "\u2013", words, remove]) {
      const cell = document.createElement("td");
      cell.append(inside);
      line.append(cell);
    }
    return line;
  }));
  $("message").textContent = told.message || "";
  $("refine").disabled = busy || !told.ready;
  $("confirm").disabled = busy || !refined;
}

async function changed() {
  const mine = ++turn;
  refined = false;
  $("frames").replaceChildren();
  draw();
  try {
    const answer = whole().length ? await ask("solve", body()) : { picks: [] };
    if (mine !== turn) return;
    told = answer;
    draw();
    const layer = told.pose && $("edges").checked ? await picture(`api/overlay/${photo.id}?${mine}`) : null;
    if (mine !== turn) return;
    panes.photo.layer = layer;
  } catch (error) {
    told = { picks: [], message: error.message };
  }
  draw();
}

async function working(words, work) {
  busy = true;
  draw();
  $("hint").textContent = words;
  let error = null;
  try { await work(); } catch (e) { error = e; }
  busy = false;
  draw();
  if (error) $("message").textContent = error.message;
}

$("refine").onclick = () => working("Registering this photo and others to the scan; this takes a minute or so.", async () => {
  const found = await ask("refine", body());
  refined = found.proposed.includes(photo.name);
  $("frames").replaceChildren(...found.frames.map((f) => {
    const line = document.createElement("li");
    line.className = f.accepted ? "good" : "bad";
    line.textContent = `${f.name}: ${f.reason ? `${f.reason}: ` : ""}${f.message}`;
    return line;
  }));
});

$("confirm").onclick = () => working("Placing the whole map.", async () => {
  const done = await ask("confirm", body());
  const box = $("result");
  box.hidden = false;
  box.className = done.placed ? "" : "bad";
  box.dataset.placed = done.placed;
  box.replaceChildren(done.placed
    ? `The map is placed: version ${done.version}. Its points lie ${done.median_m.toFixed(3)} m (median) from the scan. To undo: `
    : `Not placed: ${done.reason}: ${done.message}. `);
  if (done.undo) box.append(Object.assign(document.createElement("code"), { textContent: done.undo }));
  box.append(` The report: ${done.report}`);
  refined = false;
});

$("edges").onchange = changed;

async function choose(id) {
  photo = state.photos.find((p) => p.id === id);
  picks = [];
  panes.photo.touched = false;
  panes.photo.show(await picture(`api/photo/${id}`), [photo.width, photo.height]);
  await changed();
}

async function start() {
  state = await ask("state");
  $("title").textContent = `Place ${state.map.name || state.map.id}`;
  $("why").textContent = state.map.placed ? "The map has a place; picks give it another." : `It has no place: ${state.map.reason}`;
  const best = [...state.photos].sort((a, b) => b.points - a.points)[0];
  $("photo-choice").replaceChildren(...state.photos.map((p) => new Option(`${p.name} (${p.points} points)`, p.id, false, p === best)));
  $("photo-choice").onchange = (e) => choose(Number(e.target.value));
  panes.ground.show(await picture("api/ground.png"), [state.ground.width, state.ground.height]);
  await choose(best.id);
  return { state, panes, get told() { return told; }, get photo() { return photo; } };
}

window.featuredb = start();
