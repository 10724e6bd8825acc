/** What belongs to one pose: its ellipse, the points that agree with it, the line of a track. */

import * as THREE from "three";
import { geometryOf } from "viewer/clouds.js";
import { STATE } from "viewer/colours.js";

/**
 * The ellipse that holds 95 % of the positions, to scale, at the camera's height.
 * @param {{center: number[], ellipse: {major_m: number, minor_m: number, azimuth_deg: number}}} pose
 */
export function ellipseOf({ center: [east, north, up], ellipse }, colour) {
  const turn = (ellipse.azimuth_deg * Math.PI) / 180;
  const [sin, cos] = [Math.sin(turn), Math.cos(turn)];
  const rim = [];
  for (let k = 0; k < 96; k++) {
    const along = ellipse.major_m * Math.cos((k * Math.PI) / 48);
    const across = ellipse.minor_m * Math.sin((k * Math.PI) / 48);
    rim.push(along * sin + across * cos, along * cos - across * sin, 0);
  }
  const fan = [];
  for (let k = 0; k < 96; k++) fan.push(0, 0, 0, ...rim.slice(3 * k, 3 * k + 3), ...at(rim, (k + 1) % 96));
  const fill = new THREE.MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.25, depthTest: false });
  fill.side = THREE.DoubleSide;
  const line = new THREE.LineBasicMaterial({ color: colour, depthTest: false });
  const group = new THREE.Group().add(
    new THREE.Mesh(geometryOf(fan), fill),
    new THREE.LineLoop(geometryOf(rim), line),
  );
  for (const part of group.children) part.renderOrder = 12;
  group.position.set(east, north, up);
  return group;
}

/** Points that agree with a pose, and thin lines to them. @param {number[][]} points */
export function inliersOf(center, points, colour) {
  const dots = new THREE.PointsMaterial({ color: colour, size: 4, sizeAttenuation: false, depthTest: false });
  const rays = new THREE.LineBasicMaterial({ color: colour, transparent: true, opacity: 0.12, depthWrite: false });
  const group = new THREE.Group().add(
    new THREE.LineSegments(geometryOf(points.flatMap((point) => [...center, ...point])), rays),
    new THREE.Points(geometryOf(points.flat()), dots),
  );
  group.children[1].renderOrder = 9;
  return group;
}

/**
 * The way of a camera: a dot for each frame, by state; the line is red where frames between are lost.
 * @param {Array<any>} frames of a track
 */
export function wayOf(frames) {
  const known = frames.filter((frame) => frame.pose !== null);
  const positions = [];
  const colours = [];
  const colour = new THREE.Color();
  for (let k = 1; k < known.length; k++) {
    const [from, to] = [known[k - 1], known[k]];
    // Frames without a pose lie between them.
    const gap = frames.indexOf(to) - frames.indexOf(from) > 1;
    colour.set(gap ? STATE.lost : STATE[to.state]);
    positions.push(...from.pose.center, ...to.pose.center);
    colours.push(colour.r, colour.g, colour.b, colour.r, colour.g, colour.b);
  }
  const dots = known.flatMap((frame) => colour.set(STATE[frame.state]).toArray());
  const centers = known.flatMap((frame) => frame.pose.center);
  const line = new THREE.LineBasicMaterial({ vertexColors: true, depthTest: false });
  const dot = { depthTest: false, sizeAttenuation: false };
  const group = new THREE.Group().add(
    new THREE.LineSegments(coloured(positions, colours), line),
    new THREE.Points(geometryOf(centers), new THREE.PointsMaterial({ ...dot, size: 8 })),
    new THREE.Points(coloured(centers, dots), new THREE.PointsMaterial({ ...dot, size: 5, vertexColors: true })),
  );
  group.children.forEach((part, k) => (part.renderOrder = 12 + k));
  return group;
}

const coloured = (positions, colours) =>
  geometryOf(positions).setAttribute("color", new THREE.Float32BufferAttribute(colours, 3));

const at = (values, k) => values.slice(3 * k, 3 * k + 3);
