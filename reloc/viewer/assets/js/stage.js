/** One canvas, two cameras: the plan from above, north up, and the view in space. Draws when asked to. */

import * as THREE from "three";
import { OrbitControls } from "three/orbit";

THREE.ColorManagement.enabled = false;

const SLOW_MS = 40; // a frame that takes longer while the view moves is drawn with fewer points
const FAST_MS = 22;
const REST_MS = 250; // after which a view that moved is drawn in full
const LEAST_SHARE = 0.04;

export class Stage {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    // Without antialiasing: in software it costs two thirds of the time, and points gain nothing by it.
    this.renderer = new THREE.WebGLRenderer({ canvas });
    // Colours are data here and come out as they go in: no light is computed.
    this.renderer.outputColorSpace = THREE.LinearSRGBColorSpace;
    this.renderer.setClearColor("#f3f5f7");
    this.scene = new THREE.Scene();
    this.plan = new THREE.OrthographicCamera(-1, 1, 1, -1, 1, 10);
    this.space = new THREE.PerspectiveCamera(50, 1, 0.1, 1000);
    this.space.up.set(0, 0, 1);
    this.planControls = new OrbitControls(this.plan, canvas);
    Object.assign(this.planControls, { enableRotate: false, zoomToCursor: true, screenSpacePanning: true });
    this.planControls.mouseButtons.LEFT = THREE.MOUSE.PAN;
    this.planControls.touches.ONE = THREE.TOUCH.PAN;
    this.spaceControls = new OrbitControls(this.space, canvas);
    Object.assign(this.spaceControls, { zoomToCursor: true, screenSpacePanning: false });
    /** Share of the points that is drawn while the view moves. */
    this.share = 1;
    /** Called before each frame with the share of points to draw. @type {Array<function(number): void>} */
    this.beforeFrame = [];
    this.asked = false;
    /** Whether the view has moved since the last frame, and had before it. */
    this.moved = false;
    this.moving = false;
    this.frameAt = -Infinity;
    for (const controls of [this.planControls, this.spaceControls]) {
      controls.listenToKeyEvents(canvas);
      controls.addEventListener("change", () => {
        this.moved = true;
        this.draw();
      });
    }
    canvas.addEventListener("keydown", (event) => {
      const factor = { "+": 1.25, "=": 1.25, "-": 0.8 }[event.key];
      if (factor) this.zoom(factor);
    });
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.show("plan");
  }

  get camera() {
    return this.mode === "plan" ? this.plan : this.space;
  }

  get controls() {
    return this.mode === "plan" ? this.planControls : this.spaceControls;
  }

  /** @param {"plan"|"space"} mode */
  show(mode) {
    this.mode = mode;
    this.planControls.enabled = mode === "plan";
    this.spaceControls.enabled = mode === "space";
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    const half = (this.plan.top - this.plan.bottom) / 2;
    Object.assign(this.plan, { left: (-half * width) / height, right: (half * width) / height });
    this.plan.updateProjectionMatrix();
    this.space.aspect = width / height;
    this.space.updateProjectionMatrix();
    this.draw();
  }

  /** Both cameras see the box. @param {THREE.Box3} box */
  fit(box) {
    const center = box.getCenter(new THREE.Vector3());
    const size = box.getSize(new THREE.Vector3());
    const reach = Math.max(size.length(), 1);
    const aspect = this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1);
    const half = 0.54 * Math.max(size.y, size.x / aspect, 1);
    Object.assign(this.plan, { top: half, bottom: -half, near: 1, far: 4 * reach + 2, zoom: 1 });
    this.plan.position.set(center.x, center.y, center.z + 2 * reach + 1);
    this.planControls.target.copy(center);
    Object.assign(this.space, { near: reach / 2000, far: reach * 20 });
    this.space.position.copy(center).add(new THREE.Vector3(-0.35, -0.75, 0.55).multiplyScalar(reach));
    this.spaceControls.target.copy(center);
    this.planControls.update();
    this.spaceControls.update();
    this.resize();
  }

  /**
   * Moves both views so that a spot is in the middle.
   * @param {number} width_m of the plan
   * @param {number} covered_px at the right, where a panel lies
   */
  goTo([x, y, z], width_m, covered_px) {
    const to = new THREE.Vector3(x, y, z);
    this.plan.zoom = (this.plan.right - this.plan.left) / width_m;
    this.plan.updateProjectionMatrix();
    const shift = to.clone().sub(this.planControls.target).setZ(0);
    shift.x += (covered_px / 2) * this.metresPerPixel;
    this.plan.position.add(shift);
    this.planControls.target.add(shift);
    const back = this.space.position.clone().sub(this.spaceControls.target).setLength(width_m);
    this.spaceControls.target.copy(to);
    this.space.position.copy(to).add(back);
    this.planControls.update();
    this.spaceControls.update();
    this.draw();
  }

  zoom(factor) {
    if (this.mode === "plan") {
      this.plan.zoom *= factor;
      this.plan.updateProjectionMatrix();
    } else {
      const back = this.space.position.clone().sub(this.spaceControls.target).divideScalar(factor);
      this.space.position.copy(this.spaceControls.target).add(back);
    }
    this.controls.update();
    this.moved = true;
    this.draw();
  }

  /** Metres across the plan. */
  get widthOfPlan() {
    return (this.plan.right - this.plan.left) / this.plan.zoom;
  }

  /** Metres across a pixel in the plan. */
  get metresPerPixel() {
    return this.widthOfPlan / Math.max(this.canvas.clientWidth, 1);
  }

  /** Where a spot is seen: pixels of the canvas, or null behind the camera. @returns {?[number, number]} */
  project([x, y, z]) {
    this.camera.updateMatrixWorld(); // else it is where the last frame drew it, or nowhere before the first
    const seen = new THREE.Vector3(x, y, z).project(this.camera);
    if (seen.z < -1 || seen.z > 1) return null;
    return [((seen.x + 1) / 2) * this.canvas.clientWidth, ((1 - seen.y) / 2) * this.canvas.clientHeight];
  }

  /** East and north under a pixel of the plan. @returns {[number, number]} */
  unprojectPlan(px, py) {
    const x = (px / this.canvas.clientWidth) * 2 - 1;
    const y = 1 - (py / this.canvas.clientHeight) * 2;
    this.plan.updateMatrixWorld();
    const spot = new THREE.Vector3(x, y, 0).unproject(this.plan);
    return [spot.x, spot.y];
  }

  /** Draws with the next frame of the browser. */
  draw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => this.frame());
  }

  frame() {
    this.asked = false;
    const now = performance.now();
    const took = now - this.frameAt;
    // Frames follow each other while the view moves, so the time between two is what one takes.
    if (this.moved && this.moving && took > SLOW_MS) {
      this.share = Math.max(LEAST_SHARE, (this.share * SLOW_MS) / took);
    } else if (this.moved && this.moving && took < FAST_MS) {
      this.share = Math.min(1, this.share * 1.1);
    }
    this.moving = this.moved;
    this.moved = false;
    this.frameAt = now;
    for (const prepare of this.beforeFrame) prepare(this.moving ? this.share : 1);
    this.renderer.render(this.scene, this.camera);
    clearTimeout(this.resting);
    if (this.moving) this.resting = setTimeout(() => this.draw(), REST_MS);
  }
}
