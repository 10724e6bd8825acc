/** The panel on the right: what is known of a photo, a map, or the answer to a photo. */

import { ANSWER, SELECTED } from "viewer/colours.js";
import { byId, make, metres, table } from "viewer/dom.js";

/** Shows an element's children under a title. @param {function(): void} onClose */
export function show(title, onClose, ...children) {
  const close = make("button", { "aria-label": "Close" }, "×");
  close.addEventListener("click", onClose);
  byId("panel").replaceChildren(make("div", { class: "head" }, make("h2", {}, title), close), ...children);
  byId("panel").hidden = false;
  byId("panel").scrollTop = 0;
}

/** What is known of a photo, and a place for its picture. */
export function aboutPhoto(photo, map, openMap) {
  const link = make("button", {}, map.name || map.id);
  link.addEventListener("click", openMap);
  const frame = make("div", { id: "picture" }, make("p", { class: "note" }, "The picture is being fetched."));
  return [
    frame,
    table([["map", link], ["owner", photo.owner], ["licence", photo.licence], ["taken", photo.time]]),
    ...(photo.utm ? poseOnEarth(photo) : poseInOwnFrame(photo)),
    table([["camera", photo.camera]]),
  ];
}

function poseOnEarth(photo) {
  return [make("h3", {}, "Pose"), placeTable(photo), make("h3", {}, "Uncertainty"), ...uncertainty(photo, SELECTED)];
}

function poseInOwnFrame(photo) {
  const axes = ["x", "y", "z"].map((axis, k) => [axis, photo.center[k].toFixed(3)]);
  return [make("h3", {}, "Pose in the map's own frame"), make("p", { class: "bad" }, "No place on Earth"), table(axes)];
}

/** That a map has no place, why, and what would give it one. */
function withoutPlace(map) {
  const { reason, ways, command } = map.no_place;
  return [
    make("p", { class: "bad" }, "No place on Earth"),
    make("p", {}, `It lies in a frame of its own: ${reason}.`),
    make("h3", {}, "Place this map"),
    make("p", {}, "Click the same spots in a photo and on the scan, in a page that this command opens:"),
    make("code", { id: "place-this-map" }, command),
    make("p", {}, "What would place it:"),
    make("ul", {}, ...ways.map((way) => make("li", {}, way))),
  ];
}

/** Puts the picture, or the reason why there is none, into its place. */
export function putPicture({ url, reason }, name) {
  if (url === null) byId("picture").replaceChildren(make("p", { class: "note" }, `No picture: ${reason}.`));
  else {
    const shown = make("img", { src: url, alt: name });
    shown.addEventListener("load", () => URL.revokeObjectURL(url));
    byId("picture").replaceChildren(shown);
  }
}

/** What is known of a map, and its photos. @param {function(any): void} openPhoto */
export function aboutMap(map, nameOf, openMap, openPhoto) {
  const links = (ids) => {
    const list = make("span");
    for (const id of ids) {
      const link = make("button", { title: id }, nameOf(id));
      link.addEventListener("click", () => openMap(id));
      list.append(link, " ");
    }
    return ids.length ? list : null;
  };
  const photos = make("div", { class: "photos" });
  for (const photo of map.photos) {
    const row = make("button", {}, photo.name);
    row.addEventListener("click", () => openPhoto(photo));
    photos.append(row);
  }
  const status = map.status + (map.status_reason ? `: ${map.status_reason}` : "");
  const place = map.no_place
    ? []
    : [["placed by", map.method], ["generation", map.generation], ["lineage", map.lineage],
      ["placed by maps", links(map.parents)],
      ["drift", map.drift_m === null ? null : `${metres(map.drift_m)} (95 %), ${budget(map)}`],
      ["residual", metres(map.residual_rms_m)], ["zone", `EPSG:${map.epsg}, heights ${map.height_datum}`]];
  return [
    ...(map.no_place ? withoutPlace(map) : []),
    table([
      ["status", status], ...place,
      ["points", `${map.points.toLocaleString("en")}, ${map.buffer.count.toLocaleString("en")} drawn`],
      ["licence", map.licence], ["source", map.source], ["made", map.created_at], ["id", map.id],
    ]),
    make("h3", {}, `${map.photos.length} photos`),
    photos,
  ];
}

/**
 * The answer to a photo.
 * @param {any} answer of reloc/viewer/query.py
 * @param {function(string): string} nameOf a map
 */
export function aboutAnswer(answer, nameOf) {
  const { reply } = answer;
  if (reply.status !== "localised") {
    return [
      make("p", { class: "bad" }, `Not localised: ${reply.reason}`),
      make("p", {}, reply.detail),
      table([["inliers", String(reply.inliers)], ["matches", String(reply.matches)], ["features", String(reply.features)]]),
    ];
  }
  const { accuracy } = reply;
  return [
    make("p", { class: "good" }, "Localised"),
    make("img", { src: answer.overlay, alt: "The photo with the map's points that agree with the pose" }),
    table([["inliers", String(reply.inliers)], ["confidence", reply.confidence.toFixed(3)], ["maps", reply.maps.map(nameOf).join(", ")]]),
    make("h3", {}, "Pose"),
    placeTable({
      utm: reply.utm, height_datum: reply.height_datum,
      latitude_deg: reply.position.lat, longitude_deg: reply.position.lon,
      quaternion_xyzw: ["x", "y", "z", "w"].map((axis) => reply.quaternion[axis]), ...answer.angles,
    }),
    make("h3", {}, "Uncertainty"),
    table([
      ["68 %", `${metres(accuracy.horizontal_68_m)} in plan, ${metres(accuracy.vertical_68_m)} in height`],
      ["", `${accuracy.orientation_68_deg.toFixed(3)}°`],
    ]),
    ...(answer.pose ? uncertainty(answer.pose, ANSWER) : [make("p", { class: "note" }, "Its map is not shown here.")]),
  ];
}

function placeTable(pose) {
  const { utm } = pose;
  const degrees = (value) => (value === undefined ? null : `${value.toFixed(2)}°`);
  return table([
    ["easting", `${utm.easting.toFixed(3)} m`], ["northing", `${utm.northing.toFixed(3)} m`],
    ["height", `${utm.height.toFixed(3)} m, ${pose.height_datum}`], ["zone", `EPSG:${utm.epsg}`],
    ["latitude", `${pose.latitude_deg.toFixed(8)}°`], ["longitude", `${pose.longitude_deg.toFixed(8)}°`],
    ["heading", degrees(pose.heading_deg)], ["pitch", degrees(pose.pitch_deg)], ["roll", degrees(pose.roll_deg)],
    ["quaternion", pose.quaternion_xyzw.map((q) => q.toFixed(6)).join(", ")],
  ]);
}

/** Sigmas, and the ellipse drawn large enough to be seen, with the length of its half axes. */
function uncertainty(pose, colour) {
  const { major_m: major, minor_m: minor, azimuth_deg: azimuth } = pose.ellipse;
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const set = (element, values) => Object.entries(values).forEach(([k, v]) => element.setAttribute(k, v));
  set(svg, { width: 84, height: 84, viewBox: "-42 -42 84 84", role: "img", "aria-label": "Ellipse of 95 %, north up" });
  const part = (tag, values) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    set(element, values);
    svg.append(element);
  };
  part("path", { d: "M-40 0H40M0 40V-40M-3 -35L0 -41L3 -35", stroke: "#9aa3ad", fill: "none" });
  const across = Math.max((34 * minor) / Math.max(major, 1e-12), 1);
  part("ellipse", { rx: across, ry: 34, transform: `rotate(${azimuth})`, fill: `${colour}40`, stroke: colour });
  const [east, north, up] = pose.sigma_enu_m.map(metres);
  const about = make("div", {}, `95 %: ${metres(major)} by ${metres(minor)}, long axis ${azimuth.toFixed(0)}° from north`);
  const sigmas = pose.sigma_rotation_deg.map((v) => v.toFixed(3)).join(", ");
  return [
    make("div", { class: "ellipse" }, svg, about),
    table([["sigma e, n, u", `${east}, ${north}, ${up}`], ["about them", `${sigmas}°`]]),
  ];
}

const budget = (map) => (map.budget_m === null ? "no budget" : `budget ${metres(map.budget_m)}`);
