/** Cameras: a dot at the centre, a pyramid to the corners of the picture with a mark at its top edge. */

import * as THREE from "three";

const LINES = `
  attribute vec3 direction;
  uniform float size;
  void main() { gl_Position = projectionMatrix * modelViewMatrix * vec4(position + direction * size, 1.0); }`;
const DOTS = `
  uniform float size;
  void main() { gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); gl_PointSize = size; }`;
const PLAIN = `
  uniform vec3 colour;
  uniform float opacity;
  void main() { gl_FragColor = vec4(colour, opacity); }`;
const ROUND = `
  uniform vec3 colour;
  void main() {
    float r = length(gl_PointCoord - 0.5);
    if (r > 0.5) discard;
    gl_FragColor = vec4(mix(colour, vec3(1.0), step(0.34, r)), 1.0);
  }`;

/** @typedef {{center: number[], forward: number[], corners: number[][]}} Pose of reloc/viewer/poses.py */

/** Many cameras of one colour. */
export class Cameras {
  /** @param {Pose[]} poses @param {string} colour @param {number} dot diameter in pixels */
  constructor(poses, colour, dot = 9) {
    this.dot = dot;
    this.colour = { value: new THREE.Color(colour) };
    this.lines = new THREE.LineSegments(
      pyramids(poses),
      shader(LINES, PLAIN, { size: { value: 1 }, colour: this.colour, opacity: { value: 0.85 } }),
    );
    const centers = new Float32Array(poses.flatMap((pose) => pose.center));
    const geometry = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(centers, 3));
    this.dots = new THREE.Points(geometry, shader(DOTS, ROUND, { size: { value: dot }, colour: this.colour }));
    this.object = new THREE.Group().add(this.lines, this.dots);
    this.lines.renderOrder = 10;
    this.dots.renderOrder = 11;
    for (const part of this.object.children) part.frustumCulled = false;
  }

  paint(colour) {
    this.colour.value.set(colour);
  }

  /**
   * @param {number} depth_m of the pyramids
   * @param {boolean} hidden whether what lies in front hides them
   */
  scale(depth_m, hidden, pixelRatio) {
    this.lines.material.uniforms.size.value = depth_m;
    this.lines.material.depthTest = hidden;
    this.dots.material.depthTest = hidden;
    this.dots.material.uniforms.size.value = this.dot * pixelRatio;
  }

  dispose() {
    for (const part of this.object.children) {
      part.geometry.dispose();
      part.material.dispose();
    }
  }
}

/** How deep pyramids are: some pixels in the plan, and never larger than the cameras lie apart. */
export function depthOf(stage, spacing_m) {
  if (stage.mode === "space") return 0.4 * spacing_m;
  return Math.min(30 * stage.metresPerPixel, Math.max(0.9 * spacing_m, 9 * stage.metresPerPixel));
}

/** Median distance to the nearest other camera; some metres where there is none. @param {Pose[]} poses */
export function spacingOf(poses) {
  const step = Math.max(1, Math.floor(poses.length / 200));
  const nearest = [];
  for (let i = 0; i < poses.length; i += step) {
    let best = Infinity;
    for (let k = 0; k < poses.length; k++) {
      const gap = k === i ? Infinity : Math.hypot(...poses[i].center.map((v, c) => v - poses[k].center[c]));
      if (gap > 0.05 && gap < best) best = gap;
    }
    if (best < Infinity) nearest.push(best);
  }
  nearest.sort((a, b) => a - b);
  return nearest.length ? nearest[nearest.length >> 1] : 10;
}

/** @param {Pose[]} poses */
function pyramids(poses) {
  const centers = [];
  const directions = [];
  for (const { center, corners } of poses) {
    const [topLeft, topRight, bottomRight, bottomLeft] = corners;
    const mix = (a, b, t, out) => a.map((v, c) => (v + t * (b[c] - v)) * out);
    const top = mix(topLeft, topRight, 0.5, 1).map((v, c) => v + 0.35 * (topLeft[c] - bottomLeft[c]));
    const apex = [0, 0, 0];
    const ends = [
      ...corners.flatMap((corner) => [apex, corner]),
      ...[topLeft, topRight, topRight, bottomRight, bottomRight, bottomLeft, bottomLeft, topLeft],
      ...[mix(topLeft, topRight, 0.3, 1), top, top, mix(topLeft, topRight, 0.7, 1)],
    ];
    for (const end of ends) {
      centers.push(...center);
      directions.push(...end);
    }
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(centers, 3));
  return geometry.setAttribute("direction", new THREE.Float32BufferAttribute(directions, 3));
}

function shader(vertexShader, fragmentShader, uniforms) {
  return new THREE.ShaderMaterial({ vertexShader, fragmentShader, uniforms, transparent: true, depthWrite: false });
}
