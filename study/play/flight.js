// A flight in the browser: the module's arrays and calls, who commands, and the clocks. Nothing here draws.
"use strict";

const PARTS = {
  state: 16, desired: 6, control: 6, priority: 3, h: 13, active: 13, weights: "points", lit: "points",
  inspected: "points", ahead: "line", way: "line", answer: 3, failed: 3, score: 1,
  seen: 16, acting: 6, plant: 20, corner: 19,
};
const FAILURES = ["crash", "out_of_bounds", "out_of_power"];
const LONGEST_ACTION = 60; // s that random controls are held

async function unpacked(base64) {
  const bytes = Uint8Array.from(atob(base64), letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

async function loaded(base64) {
  const { exports } = (await WebAssembly.instantiate(await unpacked(base64), {})).instance;
  exports._initialize();
  return exports;
}

// numbers from 0 to 1 that follow from a seed (mulberry32)
function dice(seed) {
  return () => {
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

// a vector of Hill's frame in the body's, q from the body's frame to Hill's, scalar last; `back`: the other way
function turned(q, v, back = false) {
  const s = back ? 1 : -1, [x, y, z] = [s * q[0], s * q[1], s * q[2]], w = q[3];
  const t = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])];
  return [
    v[0] + w * t[0] + y * t[2] - z * t[1],
    v[1] + w * t[1] + z * t[0] - x * t[2],
    v[2] + w * t[2] + x * t[1] - y * t[0],
  ];
}

class Flight {
  // wasm: the module's exports; task: what page.py says of the task
  constructor(wasm, task, seed = 0) {
    Object.assign(this, { wasm, task, filtered: true, period: task.periods[0], pilot: "you", assistant: true });
    this.axes = "camera";
    this.erring = false; // errors are at their worst, from the next start on
    this.keys = { thrust: [0, 0, 0], torque: [0, 0, 0] }; // from -1 to 1
    this.random = dice(seed);
    const lengths = { points: task.normals.length, line: 3 * task.places };
    Object.entries(PARTS).forEach(([name, size], i) => {
      this[name] = new Float64Array(wasm.memory.buffer, wasm.at(i), lengths[size] || size);
    });
  }

  // the one that is told of errors is the last
  get filter() { return this.worst ? this.task.periods.length : this.task.periods.indexOf(this.period); }

  // seconds between two calls
  get every() { return this.worst ? this.worst.period : this.filtered ? this.period : 1; }

  get starts() { return (this.erring ? this.task.worst : this.task).starts; }

  // seed: of the plant that has the errors
  begin(start, seed = 0) {
    this.worst = this.erring ? this.task.worst : null;
    if (this.worst) this.plant.set(this.worst.plants[seed]);
    this.state.set(start.state);
    this.priority.set(start.priority);
    Object.assign(this, { start, seed });
    this.control.fill(0);
    this.desired.fill(0);
    this.answer.fill(0);
    this.active.fill(0);
    this.acting.fill(0);
    this.wasm.begin(this.worst ? 1 : 0);
    this.before = Float64Array.from(this.state);
    Object.assign(this, { time: 0, outcome: null, deltaV: 0, controls: [], corners: [], broken: {}, calls: [0, 0, 0, 0], backups: 0 });
    this.held = { until: -1, control: null };
    this.judge();
  }

  // what is wanted, into `desired`
  command() {
    const { limit } = this.task, { wasm, desired } = this;
    if (this.pilot === "agent") { // between its decisions the last control is wanted, as in the closed loop
      if (this.time % this.task.action_period === 0) wasm.decide();
      else if (!this.missed) desired.set(this.control);
    } else if (this.pilot === "guide") {
      wasm.guide(this.filter);
    } else if (this.pilot === "adversary") {
      wasm.attack();
    } else if (this.pilot === "random" || this.pilot === "outward") {
      if (this.held.until <= this.time) {
        const control = limit.map(most => (2 * this.random() - 1) * most);
        this.held = { until: this.time + Math.ceil(this.random() * LONGEST_ACTION), control };
      }
      desired.set(this.held.control);
      if (this.pilot === "outward") this.push(this.state.slice(0, 3));
    } else {
      this.fly();
    }
    limit.forEach((most, j) => { desired[j] = Math.max(-most, Math.min(most, desired[j])); });
  }

  // full thrust along a direction of Hill's frame
  push(direction) {
    const along = turned(this.state.slice(6, 10), direction), most = Math.max(...along.map(Math.abs)) || 1;
    along.forEach((each, j) => { this.desired[j] = each / most * this.task.limit[j]; });
  }

  fly() {
    const { thrust, torque } = this.keys, { limit } = this.task;
    const body = this.axes === "hill" ? turned(this.state.slice(6, 10), thrust) : thrust;
    const turns = torque.some(Boolean);
    for (let j = 0; j < 3; j++) {
      this.desired[j] = body[j] * limit[j];
      this.desired[3 + j] = turns ? torque[j] * limit[3 + j] : 0;
    }
    if (this.assistant && !turns) this.wasm.assist(this.filter);
  }

  // whether the last call was, so that the control before it is held
  get missed() { return this.corner[18] > 0; }

  // one second
  second() {
    if (this.outcome) return;
    const { wasm, task } = this;
    if (this.time % this.every === 0) {
      wasm.sense();
      this.command();
      wasm.ask(this.filter, this.filtered ? 1 : 0);
      if (this.filtered && !this.missed) {
        this.calls[this.answer[0]] += 1;
        this.backups += this.answer[2];
      }
    }
    this.before.set(this.state);
    this.controls.push(Array.from(this.control));
    this.corners.push(Array.from(this.corner));
    const thrust = this.acting.slice(0, 3).reduce((sum, each) => sum + Math.abs(each), 0);
    const mass = this.worst ? this.plant[0] : task.mass;
    for (let k = 0; k < task.steps && !this.outcome; k++) {
      wasm.fly();
      this.deltaV += thrust / mass / task.steps;
      this.outcome = FAILURES.find((_, i) => this.failed[i] > 0) || null;
    }
    this.time += 1;
    if (this.time % task.action_period === 0) {
      wasm.look();
      if (!this.outcome && this.score[0] >= task.success_score) this.outcome = "success";
      if (!this.outcome && this.time >= task.max_time) this.outcome = "timeout";
    }
    this.judge();
  }

  // which limits are violated, and since when
  judge() {
    this.task.limits.forEach(({ name }, i) => {
      if (!(this.h[i] >= 0) && !(name in this.broken)) this.broken[name] = this.time;
    });
  }

  // what --initial-state of simulate reads
  saved_state() {
    const x = this.start.state;
    return JSON.stringify({
      position: x.slice(0, 3), velocity: x.slice(3, 6), quaternion: x.slice(6, 10), angular_velocity: x.slice(10, 13),
      temperature: x[13], energy: x[14], sun_angle: x[15], priority_vector: this.start.priority,
    });
  }

  get settings() { return (this.worst || this.task).settings; }

  // what flies the saved flight again, with the settings of the page where they are not the usual ones
  command_again() {
    const settings = this.settings ? " --config flight.toml" : "", seed = this.worst ? `--seed ${this.seed} ` : "";
    return `python main.py simulate${settings} --no-rta --controller recorded --actions flight.npy --initial-state flight.json `
      + `${seed}--step 1 --duration ${Math.max(1, this.time)} --out flight.npz && python main.py replay flight.npz --out flight.html`;
  }

  // what --actions of simulate reads: the controls that were flown and, with errors, where these were, a row a second, as an .npy
  // file
  saved_controls() {
    const rows = this.controls.map((control, i) => (this.worst ? [...control, ...this.corners[i]] : control));
    const text = `{'descr': '<f8', 'fortran_order': False, 'shape': (${rows.length}, ${this.worst ? 25 : 6}), }`;
    const length = Math.ceil((10 + text.length + 1) / 64) * 64;
    const head = new Uint8Array(length).fill(32);
    head.set([0x93, 78, 85, 77, 80, 89, 1, 0, (length - 10) & 255, (length - 10) >> 8]);
    head.set(Uint8Array.from(text, letter => letter.charCodeAt(0)), 10);
    head[length - 1] = 10;
    const bytes = new Uint8Array(length + 8 * rows.flat().length);
    bytes.set(head);
    const view = new DataView(bytes.buffer);
    rows.flat().forEach((each, i) => view.setFloat64(length + 8 * i, each, true));
    return bytes;
  }
}
