// The picture of the flight that is flown now.
"use strict";

class Picture extends Scene {
  constructor(canvas, task) {
    const points = task.normals.map(normal => normal.map(each => task.chief_radius * each));
    super(canvas, { ...task, points, triangles: null, hull: null });
    this.ahead = this.line(COLOURS.ahead, 0.45, task.places);
    this.way = this.line(COLOURS.way, 1, task.places, 4);
    this.trail = this.line(COLOURS.trail, 0.8, task.max_time + 2);
  }

  begin(flight) {
    this.flownTo = 0;
    this.trail.geometry.setDrawRange(0, 0);
    this.renew(flight);
  }

  // what changes with each second
  renew(flight) {
    const { inspected, lit, state } = flight;
    this.colour(Array.from(inspected, (seen, i) => (seen ? "inspected" : lit[i] ? "lit" : "dark")));
    const trail = this.trail.geometry.attributes.position;
    if (this.flownTo < trail.count) {
      trail.setXYZ(this.flownTo++, state[0], state[1], state[2]);
      trail.needsUpdate = true;
      this.trail.geometry.setDrawRange(0, this.flownTo);
    }
    flight.wasm.coast(this.task.ahead_steps);
    this.fill(this.ahead, flight.ahead, this.task.places);
    this.fill(this.way, flight.way, flight.filtered ? flight.wasm.rest(flight.filter) : 0);
  }

  // a share of the way from the state before to the one now
  show(flight, share) {
    const { before: a, state: b, desired, control } = flight;
    const mixed = i => a[i] + share * (b[i] - a[i]);
    const q = new THREE.Quaternion(...a.slice(6, 10)).slerp(new THREE.Quaternion(...b.slice(6, 10)), share).toArray();
    this.draw({ p: [0, 1, 2].map(mixed), q, sun: mixed(15), desired, control });
  }
}
