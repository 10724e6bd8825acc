// A picture that can be moved and zoomed, with numbered marks that can be set and dragged.

const REACH = 12; // pixels of the screen within which a mark is taken hold of

export class Pane {
  constructor(canvas, told) {
    this.canvas = canvas;
    this.told = told; // {pick(x, y), move(row, x, y), marks() -> [{x, y, row, state, to}]}
    this.picture = null;
    this.layer = null;
    this.size = [1, 1];
    this.view = { scale: 1, x: 0, y: 0 };
    canvas.addEventListener("pointerdown", (e) => this.down(e));
    canvas.addEventListener("pointermove", (e) => this.moved(e));
    canvas.addEventListener("pointerup", (e) => this.up(e));
    canvas.addEventListener("wheel", (e) => this.wheel(e), { passive: false });
    new ResizeObserver(() => this.resized()).observe(canvas);
  }

  // size: of the picture in its own coordinates, whatever pixels were sent.
  show(picture, size) {
    this.picture = picture;
    this.layer = null;
    this.size = size;
    this.resized(true);
  }

  fit() {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    const scale = Math.min(w / this.size[0], h / this.size[1]) || 1;
    this.view = { scale, x: (w - scale * this.size[0]) / 2, y: (h - scale * this.size[1]) / 2 };
  }

  resized(anew = false) {
    const ratio = devicePixelRatio || 1;
    this.canvas.width = this.canvas.clientWidth * ratio;
    this.canvas.height = this.canvas.clientHeight * ratio;
    if (anew || !this.touched) this.fit();
    this.draw();
  }

  toScreen(x, y) { return [this.view.x + this.view.scale * x, this.view.y + this.view.scale * y]; }
  toPicture(x, y) { return [(x - this.view.x) / this.view.scale, (y - this.view.y) / this.view.scale]; }

  at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  down(event) {
    const [x, y] = this.at(event);
    const near = this.told.marks().find((m) => {
      const [mx, my] = this.toScreen(m.x, m.y);
      return Math.hypot(mx - x, my - y) < REACH;
    });
    this.held = { x, y, row: near ? near.row : -1, far: false };
    this.canvas.setPointerCapture(event.pointerId);
  }

  moved(event) {
    if (!this.held) return;
    const [x, y] = this.at(event), held = this.held;
    if (Math.hypot(x - held.x, y - held.y) > 4) held.far = true;
    if (!held.far) return;
    if (held.row >= 0) this.told.move(held.row, ...this.toPicture(x, y), false);
    else {
      this.view.x += x - held.x;
      this.view.y += y - held.y;
      [held.x, held.y] = [x, y];
      this.touched = true;
    }
    this.draw();
  }

  up(event) {
    const held = this.held;
    this.held = null;
    if (!held) return;
    const [x, y] = this.toPicture(...this.at(event));
    if (held.row >= 0) { if (held.far) this.told.move(held.row, x, y, true); }
    else if (!held.far && x >= 0 && y >= 0 && x <= this.size[0] && y <= this.size[1]) this.told.pick(x, y);
    this.draw();
  }

  wheel(event) {
    event.preventDefault();
    const [x, y] = this.at(event), [px, py] = this.toPicture(x, y);
    this.view.scale *= Math.exp(-event.deltaY * 0.0015);
    this.view.x = x - this.view.scale * px;
    this.view.y = y - this.view.scale * py;
    this.touched = true;
    this.draw();
  }

  draw() {
    const c = this.canvas.getContext("2d"), ratio = devicePixelRatio || 1, { scale, x, y } = this.view;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, this.canvas.width, this.canvas.height);
    c.imageSmoothingEnabled = scale * this.size[0] < 3 * (this.picture ? this.picture.width : 1);
    for (const picture of [this.picture, this.layer])
      if (picture) c.drawImage(picture, x, y, scale * this.size[0], scale * this.size[1]);
    for (const mark of this.told.marks()) this.mark(c, mark);
  }

  mark(c, { x, y, row, state, to }) {
    const [mx, my] = this.toScreen(x, y), colour = { wrong: "#e5392f", half: "#ffffff" }[state] || "#ffd23f";
    if (to) {
      const [tx, ty] = this.toScreen(...to);
      for (const [wide, ink] of [[4, "#000a"], [2, colour]]) {
        c.lineWidth = wide;
        c.strokeStyle = ink;
        c.beginPath();
        c.moveTo(mx, my);
        c.lineTo(tx, ty);
        c.stroke();
      }
    }
    for (const [wide, ink] of [[4, "#000a"], [2, colour]]) {
      c.lineWidth = wide;
      c.strokeStyle = ink;
      c.beginPath();
      c.arc(mx, my, 8, 0, 2 * Math.PI);
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        c.moveTo(mx + 4 * dx, my + 4 * dy);
        c.lineTo(mx + 12 * dx, my + 12 * dy);
      }
      c.stroke();
    }
    c.font = "bold 13px system-ui, sans-serif";
    c.lineWidth = 3;
    c.strokeStyle = "#000c";
    c.strokeText(row + 1, mx + 11, my - 9);
    c.fillStyle = colour;
    c.fillText(row + 1, mx + 11, my - 9);
  }
}
