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
    const size = { value: 1 };
    const white = { size, colour: { value: new THREE.Color("#ffffff") }, opacity: { value: 0.4 } };
    this.bases = new THREE.Mesh(bases(poses), shader(LINES, PLAIN, white));
    this.bases.material.side = THREE.DoubleSide;
    const edges = { size, colour: this.colour, opacity: { value: 1 } };
    this.lines = new THREE.LineSegments(pyramids(poses), shader(LINES, PLAIN, edges));
    const centers = new Float32Array(poses.flatMap((pose) => pose.center));
    const geometry = new THREE.BufferGeometry().setAttribute("position", new THREE.BufferAttribute(centers, 3));
    this.dots = new THREE.Points(geometry, shader(DOTS, ROUND, { size: { value: dot }, colour: this.colour }));
    this.object = new THREE.Group().add(this.bases, this.lines, this.dots);
    this.bases.renderOrder = 9;
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
    for (const part of this.object.children) part.material.depthTest = hidden;
    this.dots.material.uniforms.size.value = this.dot * pixelRatio;
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

/** The picture's rectangle of each, two triangles; light, so that edges show on any ground. */
function bases(poses) {
  return shapes(poses, ({ corners: [a, b, c, d] }) => [a, b, c, a, c, d]);
}

/** @param {Pose[]} poses */
function pyramids(poses) {
  const apex = [0, 0, 0];
  const mix = (a, b, t) => a.map((v, c) => v + t * (b[c] - v));
  return shapes(poses, ({ corners }) => {
    const [topLeft, topRight, bottomRight, bottomLeft] = corners;
    const top = mix(topLeft, topRight, 0.5).map((v, c) => v + 0.35 * (topLeft[c] - bottomLeft[c]));
    return [
      ...corners.flatMap((corner) => [apex, corner]),
      ...[topLeft, topRight, topRight, bottomRight, bottomRight, bottomLeft, bottomLeft, topLeft],
      ...[mix(topLeft, topRight, 0.3), top, top, mix(topLeft, topRight, 0.7)],
    ];
  });
}

/** Vertices at the cameras' centres, each with the direction in which the shader moves it. */
function shapes(poses, endsOf) {
  const centers = [];
  const directions = [];
  for (const pose of poses) {
    for (const end of endsOf(pose)) {
      centers.push(...pose.center);
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
