/** The page: loads the scene, and joins its parts. */

import * as THREE from "three";
import { discard, Ground } from "viewer/clouds.js";
import { ANSWER, colourOfMap, SCAN, SELECTED } from "viewer/colours.js";
import { Controls } from "viewer/controls.js";
import { ask, loadPoints, loadScene, picture } from "viewer/data.js";
import { byId, check, make } from "viewer/dom.js";
import { ellipseOf, inliersOf } from "viewer/figures.js";
import { Cameras, depthOf, spacingOf } from "viewer/markers.js";
import { aboutAnswer, aboutMap, aboutPhoto, putPicture, show } from "viewer/panel.js";
import { Player } from "viewer/player.js";
import { Pointing } from "viewer/pointing.js";
import { Stage } from "viewer/stage.js";
import { Tree } from "viewer/tree.js";

class Viewer {
  /** @param {any} document_ of reloc/viewer/scene.py */
  constructor(document_) {
    this.document = document_;
    this.stage = new Stage(byId("canvas"));
    this.player = new Player(this.stage);
    this.selection = new THREE.Group();
    this.selectedCameras = null;
    this.number = 0;
    this.stage.scene.add(this.player.object, this.selection);
    this.stage.beforeFrame.push((share) => this.prepare(share));
    this.controls = new Controls(this);
    this.pointing = new Pointing(this);
  }

  get place() {
    return this.document.places[this.number];
  }

  /** @param {number} number of the place */
  async open(number) {
    this.number = number;
    const data = await loadPoints(number);
    if (this.number !== number) return; // another place was chosen meanwhile
    if (this.ground) [this.ground, ...this.cameras].forEach((layer) => discard(layer.object));
    this.close();
    this.ground = new Ground(this.place, data);
    this.cameras = this.place.maps.map((map, row) => new Cameras(map.photos, colourOfMap("map", map, row)));
    this.spacing = spacingOf(this.place.maps.flatMap((map) => map.photos));
    this.stage.scene.add(this.ground.object, ...this.cameras.map((cameras) => cameras.object));
    this.tree = new Tree(byId("tree"), this.place.maps, (id) => this.openMap(id), () => this.refresh());
    this.scanBoxes = this.place.scans.map((scan) => {
      const about = ` (${scan.buffer.count.toLocaleString("en")} of ${scan.points_here.toLocaleString("en")} points)`;
      return check(scan.name + about, true, () => this.refresh(), SCAN).querySelector("input");
    });
    byId("scans").replaceChildren(...this.scanBoxes.map((box) => make("li", {}, box.parentElement)));
    byId("scans-section").hidden = this.scanBoxes.length === 0;
    byId("own-frame").hidden = !this.place.own;
    this.controls.showMode(this.stage.mode);
    this.controls.fill(this.place);
    this.player.load(this.place.trajectories);
    this.refresh();
    this.fit();
  }

  /** Shows what the boxes say, in the colours that are chosen. */
  refresh() {
    const { kinds, mode, size } = this.controls;
    this.ground.paint(mode);
    this.ground.size(size);
    this.tree.paint((map, row) => colourOfMap(mode, map, row));
    this.tree.fade((map) => this.controls.takes(map));
    this.place.maps.forEach((map, row) => {
      const shown = this.tree.isShown(map.id) && this.controls.takes(map);
      this.ground.maps[row].object.visible = shown && kinds.points;
      this.ground.covers[row].visible = shown && kinds.coverage;
      this.cameras[row].object.visible = shown && kinds.photos;
      this.cameras[row].paint(colourOfMap(mode, map, row));
    });
    this.scanBoxes.forEach((box, row) => (this.ground.scans[row].object.visible = box.checked && kinds.points));
    this.player.object.visible = kinds.tracks;
    this.controls.drawLegend();
    this.stage.draw();
  }

  /** Both views show all of the place. */
  fit() {
    const box = new THREE.Box3();
    for (const cloud of [...this.ground.maps, ...this.ground.scans]) {
      if (cloud.buffer.count) for (const corner of cloud.buffer.box) box.expandByPoint(new THREE.Vector3(...corner));
    }
    const tracks = this.place.trajectories.flatMap((track) => track.frames.map((frame) => frame.pose));
    for (const pose of [...this.place.maps.flatMap((map) => map.photos), ...tracks.filter(Boolean)]) {
      box.expandByPoint(new THREE.Vector3(...pose.center));
    }
    if (box.isEmpty()) box.set(new THREE.Vector3(-50, -50, 0), new THREE.Vector3(50, 50, 20));
    this.stage.fit(box);
  }

  /** Before each frame: as many points as are drawn in time, pyramids that fit the zoom. */
  prepare(share) {
    this.ground?.drawShare(share);
    const depth = depthOf(this.stage, this.spacing ?? 10);
    const ratio = this.stage.renderer.getPixelRatio();
    for (const cameras of this.cameras ?? []) cameras.scale(depth, this.stage.mode === "space", ratio);
    this.selectedCameras?.scale(1.6 * depth, false, ratio);
    this.player.camera?.scale(1.6 * depth, false, ratio);
    this.pointing.drawScale();
  }

  /** @param {"plan"|"space"} mode */
  view(mode) {
    this.stage.show(mode);
    this.controls.showMode(mode);
    this.pointing.leave();
  }

  map(id) {
    return this.place.maps.find((map) => map.id === id);
  }

  nameOf(id) {
    return this.document.places.flatMap((place) => place.maps).find((map) => map.id === id)?.name || id;
  }

  /** A map in the panel. @param {string} id */
  openMap(id) {
    const map = this.map(id);
    if (map === undefined) return;
    this.close();
    this.tree.mark(id);
    const photo = (p) => this.openPhoto(map, p);
    const body = aboutMap(map, (m) => this.nameOf(m), (m) => this.openMap(m), photo);
    const there = make("button", {}, "Go there");
    there.addEventListener("click", () => this.goToMap(map));
    show(map.name || map.id, () => this.close(), there, ...body);
  }

  /** The view on a map's points, or on its photos where it has none. */
  goToMap(map) {
    const box = new THREE.Box3();
    const spots = map.buffer.count ? map.buffer.box : map.photos.map((photo) => photo.center);
    for (const spot of spots) box.expandByPoint(new THREE.Vector3(...spot));
    if (box.isEmpty()) return;
    const size = box.getSize(new THREE.Vector3());
    const across = Math.max(size.x, size.y * this.stage.space.aspect, 20);
    const covered = byId("panel").offsetWidth;
    const free = 1 - covered / this.stage.canvas.clientWidth;
    this.stage.goTo(box.getCenter(new THREE.Vector3()).toArray(), (1.1 * across) / free, covered);
  }

  /** A photo in the panel, its camera and ellipse in the view. */
  async openPhoto(map, photo) {
    this.close();
    this.tree.mark(map.id);
    show(photo.name, () => this.close(), ...aboutPhoto(photo, map, () => this.openMap(map.id)));
    this.select(photo, SELECTED);
    const found = await picture(map.id, photo.id);
    if (this.selected === photo) putPicture(found, photo.name);
  }

  /** Asks where a photo was taken, and shows the answer. @param {File} file */
  async ask(file) {
    this.close();
    const text = "The photo is being localised. The first one waits for the index.";
    const waiting = make("p", { class: "note", role: "status" }, text);
    show(file.name, () => this.close(), waiting);
    const question = (this.question = {});
    try {
      const answer = await ask(file, byId("exif-prior").checked);
      if (this.question !== question) return; // another photo was dropped meanwhile
      if (answer.place !== undefined && answer.place !== this.number) await this.controls.goToPlace(answer.place);
      this.close();
      show(file.name, () => this.close(), ...aboutAnswer(answer, (id) => this.nameOf(id)));
      if (answer.pose) {
        this.select(answer.pose, ANSWER);
        this.selection.add(inliersOf(answer.pose.center, answer.points, ANSWER));
        const width_m = Math.max(12 * this.spacing, 10 * answer.pose.ellipse.major_m);
        this.stage.goTo(answer.pose.center, Math.min(width_m, this.stage.widthOfPlan), byId("panel").offsetWidth);
      }
    } catch (error) {
      waiting.textContent = `No answer: ${error.message}`;
    }
  }

  /** Draws a pose as the selected one. */
  select(pose, colour) {
    this.selected = pose;
    this.selectedCameras = new Cameras([pose], colour, 14);
    this.selection.add(this.selectedCameras.object);
    if (pose.ellipse) this.selection.add(ellipseOf(pose, colour));
    this.stage.draw();
  }

  /** Nothing is selected. */
  close() {
    this.selected = null;
    [...this.selection.children].forEach(discard);
    this.selectedCameras = null;
    this.tree?.mark(null);
    byId("panel").hidden = true;
    this.stage.draw();
  }
}

async function start() {
  const message = byId("message");
  try {
    const scene = await loadScene();
    document.title = `${scene.database} – featuredb`;
    byId("title").textContent = scene.database;
    byId("subtitle").textContent = `version ${scene.snapshot} of ${scene.time.replace("T", " ")}`;
    byId("drop").hidden = !scene.queries;
    byId("no-queries").hidden = scene.queries;
    if (scene.places.length === 0) {
      const command = "featuredb ingest photos DB FOLDER";
      message.textContent = `There is no map and no scan in this database yet: ${command} makes maps of photos.`;
      message.hidden = false;
      return null;
    }
    const viewer = new Viewer(scene);
    await viewer.open(0);
    return viewer;
  } catch (error) {
    message.textContent = `The page cannot be shown: ${error.message}`;
    message.hidden = false;
    throw error;
  }
}

/** For programs that drive the page: the viewer, or null where there is nothing to show. */
window.featuredb = start();
