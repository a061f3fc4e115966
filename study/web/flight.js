// A flight in the browser: the module's arrays and calls, the controllers, and the clocks. Nothing here draws.
"use strict";

const FAILURES = ["crash", "out_of_bounds", "out_of_power"];
const LONGEST_ACTION = 60; // s, longest hold of a random control

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

class Flight {
  // wasm: the module's exports; task: the data of `task` in play.py
  constructor(wasm, task) {
    Object.assign(this, { wasm, task, filtered: true, period: task.periods[0], pilot: "you", assistant: true, random: Math.random });
    this.erring = false; // whether errors are worst, from the next start on
    this.keys = { thrust: [0, 0, 0], torque: [0, 0, 0] }; // from -1 to 1, along the body's axes
    for (const [name, size] of Object.entries(task.arrays)) this[name] = new Float64Array(wasm.memory.buffer, wasm[name].value, size);
  }

  // the number of the called filter; the last filter is the one with error bounds
  get filter() { return this.worst ? this.task.periods.length : this.task.periods.indexOf(this.period); }

  // seconds between two calls
  get every() { return this.worst ? this.world.period : this.filtered ? this.period : 1; }

  get starts() { return this.task.worlds[Number(this.erring)].starts; }

  // seed: of the plant with errors
  begin(start, seed = 0) {
    const { wasm, task } = this;
    this.worst = this.erring;
    this.world = task.worlds[Number(this.worst)];
    for (const name of Object.keys(task.arrays)) this[name].fill(0);
    if (this.worst) this.plant.set(this.world.plants[seed]);
    this.state.set(start.state);
    this.priority.set(start.priority);
    this.before = Float64Array.from(this.state);
    Object.assign(this, { start, seed, time: 0, outcome: null, deltaV: 0, controls: [], corners: [], broken: {}, calls: [0, 0, 0, 0] });
    this.held = { until: -1, control: null };
    wasm.begin();
    if (this.worst) wasm.worst_begin();
    if (wasm.agent_begin) wasm.agent_begin();
    this.look();
    this.judge();
  }

  look() {
    this.wasm.look();
    if (this.wasm.agent_look) this.wasm.agent_look();
  }

  // writes the desired control into `desired`
  command() {
    const { limit } = this.task, { wasm, desired, time } = this;
    if (this.pilot === "agent") { // between its decisions it desires the last control, as in the closed loop
      if (time % this.task.action_period === 0) wasm.agent_decide();
      else if (!this.missed) desired.set(this.control);
    } else if (this.pilot === "guide") {
      wasm[`guide_${this.filter}`]();
    } else if (this.pilot === "adversary") {
      wasm.attack();
    } else if (this.pilot === "random") {
      if (this.held.until <= time) {
        const control = limit.map(most => (2 * this.random() - 1) * most);
        this.held = { until: time + Math.ceil(this.random() * LONGEST_ACTION), control };
      }
      desired.set(this.held.control);
    } else {
      const { thrust, torque } = this.keys;
      desired.set([...thrust, ...torque].map((share, j) => share * limit[j]));
      if (this.assistant && !torque.some(Boolean)) wasm[`assist_${this.filter}`]();
    }
    limit.forEach((most, j) => { desired[j] = Math.max(-most, Math.min(most, desired[j])); });
  }

  // a call of the filter: from `state` to `seen`, and from `desired` to `control` and `acting`
  call() {
    const { wasm } = this;
    if (this.worst) wasm.worst_sense();
    else this.seen.set(this.state);
    this.command();
    this.control.set(this.desired);
    this.active.fill(0);
    this.answer.fill(0);
    if (this.filtered) wasm[`ask_${this.filter}`]();
    this.acting.set(this.control);
    if (this.worst) wasm.worst_hold();
    if (this.filtered && !this.missed) this.calls[this.answer[0]] += 1;
  }

  // whether the last call was missed, so that the control before it is held
  get missed() { return this.corner[18] > 0; }

  // flies one second
  second() {
    if (this.outcome) return;
    const { wasm, task } = this;
    if (this.time % this.every === 0) this.call();
    this.before.set(this.state);
    this.controls.push(Array.from(this.control));
    this.corners.push(Array.from(this.corner));
    const thrust = this.acting.slice(0, 3).reduce((sum, each) => sum + Math.abs(each), 0);
    const mass = this.worst ? this.plant[0] : task.mass;
    for (let k = 0; k < task.steps && !this.outcome; k++) {
      if (this.worst) wasm.worst_fly();
      else wasm.fly();
      wasm.judge();
      this.deltaV += thrust / mass / task.steps;
      this.outcome = FAILURES.find((_, i) => this.failed[i] > 0) || null;
    }
    this.time += 1;
    if (this.time % task.action_period === 0) {
      this.look();
      if (!this.outcome && this.score[0] >= task.success_score) this.outcome = "success";
      if (!this.outcome && this.time >= task.max_time) this.outcome = "timeout";
    }
    this.judge();
  }

  // notes which limits are violated, and since when
  judge() {
    this.wasm.judge();
    this.task.limits.forEach(({ name }, i) => {
      if (!(this.values[i] >= 0) && !(name in this.broken)) this.broken[name] = this.time;
    });
  }

  // returns the file for --initial-state of simulate
  saved_state() {
    const x = this.start.state;
    return JSON.stringify({
      position: x.slice(0, 3), velocity: x.slice(3, 6), quaternion: x.slice(6, 10), angular_velocity: x.slice(10, 13),
      temperature: x[13], energy: x[14], sun_angle: x[15], priority_vector: this.start.priority,
    });
  }

  // returns the commands that fly the saved flight again
  command_again() {
    const seed = this.worst ? `--seed ${this.seed} ` : "";
    return `python main.py simulate --config flight.toml --no-rta --controller recorded --actions flight.npy --initial-state flight.json `
      + `${seed}--step 1 --duration ${Math.max(1, this.time)} --out flight.npz && python main.py replay flight.npz --out flight.html`;
  }

  // returns the .npy file for --actions of simulate, a row per second: the controls and, with errors, their corners
  saved_controls() {
    const rows = this.controls.map((control, i) => (this.worst ? [...control, ...this.corners[i]] : control));
    const text = `{'descr': '<f8', 'fortran_order': False, 'shape': (${rows.length}, ${this.worst ? 25 : 6}), }`;
    const length = Math.ceil((10 + text.length + 1) / 64) * 64;
    const head = `\x93NUMPY\x01\x00${String.fromCharCode((length - 10) & 255, (length - 10) >> 8)}${text.padEnd(length - 11)}\n`;
    const bytes = new Uint8Array(length + 8 * rows.flat().length);
    bytes.set(Array.from(head, letter => letter.charCodeAt(0)));
    const view = new DataView(bytes.buffer);
    rows.flat().forEach((each, i) => view.setFloat64(length + 8 * i, each, true));
    return bytes;
  }
}
