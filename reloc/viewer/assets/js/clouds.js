/** Points of maps and scans, and what maps cover in plan. */

import * as THREE from "three";
import { colourOfMap, heightColours, SCAN } from "viewer/colours.js";

/** One map's or scan's points. */
export class Cloud {
  /**
   * @param {ArrayBuffer} data points of the whole place
   * @param {{origin: number[], count: number, offset: number, box: number[][]}} buffer where they are
   */
  constructor(data, buffer) {
    this.buffer = buffer;
    this.xyz = new Float32Array(data, buffer.offset, 3 * buffer.count);
    this.own = new Uint8Array(data, buffer.offset + 12 * buffer.count, 3 * buffer.count);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(this.xyz, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(this.own, 3, true));
    this.material = new THREE.PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: true });
    this.object = new THREE.Points(geometry, this.material);
    this.object.position.fromArray(buffer.origin);
    this.byHeight = null;
  }

  /** @param {string} mode @param {string} colour of all points where they have none each */
  paint(mode, colour, range) {
    const each = mode === "own" || mode === "height";
    if (each) {
      if (mode === "height" && this.byHeight === null) {
        this.byHeight = heightColours(this.xyz, this.buffer.origin[2], range);
      }
      const rgb = mode === "own" ? this.own : this.byHeight;
      this.object.geometry.setAttribute("color", new THREE.BufferAttribute(rgb, 3, true));
    }
    this.material.color.set(each ? "#ffffff" : colour);
    this.material.vertexColors = each;
    this.material.needsUpdate = true;
  }

  /** Any first part of the points is a sample of all. @param {number} share in (0, 1] */
  drawShare(share) {
    this.object.geometry.setDrawRange(0, Math.ceil(this.buffer.count * share));
  }
}

/** Square cells that hold points, and the line around them, at the ground. */
export function coverageOf({ ground_m: ground, cell_m: cell, cells, hull }, colour) {
  const group = new THREE.Group();
  const corners = [[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]];
  const squares = cells.flatMap(([i, j]) => corners.flatMap(([a, b]) => [(i + a) * cell, (j + b) * cell, ground]));
  const fill = new THREE.MeshBasicMaterial({ color: colour, transparent: true, opacity: 0.22, depthWrite: false });
  fill.side = THREE.DoubleSide;
  group.add(new THREE.Mesh(geometryOf(squares), fill));
  const line = hull.flatMap(([e, n]) => [e, n, ground]);
  group.add(new THREE.LineLoop(geometryOf(line), new THREE.LineBasicMaterial({ color: colour })));
  return group;
}

/** @param {number[]} positions x, y, z of each vertex */
export function geometryOf(positions) {
  return new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
}

/** The clouds and covers of a place. */
export class Ground {
  /** @param {any} place @param {ArrayBuffer} data */
  constructor(place, data) {
    this.place = place;
    this.object = new THREE.Group();
    this.maps = place.maps.map((map) => new Cloud(data, map.buffer));
    this.scans = place.scans.map((scan) => new Cloud(data, scan.buffer));
    this.covers = place.maps.map((map, row) => coverageOf(map.coverage, colourOfMap("map", map, row)));
    for (const cloud of [...this.scans, ...this.maps]) this.object.add(cloud.object);
    for (const cover of this.covers) this.object.add(cover);
    const ranges = [...this.maps, ...this.scans].filter((c) => c.buffer.count).map((c) => c.buffer.box);
    /** Lowest and highest point, strays apart, above the frame's origin. */
    this.heights = [Math.min(...ranges.map((box) => box[0][2])), Math.max(...ranges.map((box) => box[1][2]))];
  }

  /** @param {string} mode */
  paint(mode) {
    this.maps.forEach((cloud, row) => cloud.paint(mode, colourOfMap(mode, this.place.maps[row], row), this.heights));
    this.scans.forEach((cloud) => cloud.paint(mode, SCAN, this.heights));
    this.covers.forEach((cover, row) => {
      for (const part of cover.children) part.material.color.set(colourOfMap(mode, this.place.maps[row], row));
    });
  }

  /** @param {number} pixels */
  size(pixels) {
    for (const cloud of [...this.maps, ...this.scans]) cloud.material.size = pixels;
  }

  drawShare(share) {
    for (const cloud of [...this.maps, ...this.scans]) cloud.drawShare(share);
  }
}

/** Takes objects out of the view for good. @param {THREE.Object3D} group */
export function discard(group) {
  group.traverse((object) => {
    object.geometry?.dispose();
    object.material?.dispose();
  });
  group.removeFromParent();
}
