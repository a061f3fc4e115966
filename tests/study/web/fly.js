// Flies the page's own flight without a browser: node fly.js PAGE < flights.json > results.json
"use strict";
const fs = require("fs");
const vm = require("vm");

const page = fs.readFileSync(process.argv[2], "utf8");
const inside = id => page.match(new RegExp(`<script[^>]* id="${id}">([^]*?)</script>`))[1];
const source = [...page.matchAll(/<script>([^]*?)<\/script>/g)].map(found => found[1]).find(text => text.includes("class Flight"));
const { Flight, loaded } = vm.runInThisContext(`(() => { ${source}\nreturn { Flight, loaded }; })()`);
const task = JSON.parse(inside("data"));

// numbers from 0 to 1 that follow from a seed (mulberry32)
function dice(seed) {
  return () => {
    seed = (seed + 0x6d2b79f5) | 0;
    let t = Math.imul(seed ^ (seed >>> 15), 1 | seed);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

// somebody who holds keys at random for up to 20 s
function keys(flight, random) {
  if (flight.time < flight.until) return;
  flight.until = flight.time + Math.ceil(20 * random());
  for (const kind of ["thrust", "torque"]) flight.keys[kind] = [0, 1, 2].map(() => Math.floor(3 * random()) - 1);
  if (random() < 0.5) flight.keys.torque = [0, 0, 0]; // the assistant's turn
}

// plant: the number of the one that has the errors, where `erring`; toggle: when the filter is switched; calls: all are told
function flown(wasm, { start, seconds, seed = 0, plant = 0, calls = false, toggle = 0, ...chosen }) {
  const flight = Object.assign(new Flight(wasm, task), { until: 0, random: dice(seed) }, chosen), random = dice(seed + 1);
  const found = { calls: [], states: [] }, call = flight.call.bind(flight);
  if (chosen.pilot === "keys") flight.pilot = "you";
  flight.begin(flight.starts.find(each => each.name === start), plant);
  flight.call = () => {
    call();
    if (!calls || !flight.filtered) return;
    const places = wasm[`rest_${flight.filter}`](), told = { missed: flight.missed, places };
    for (const name of ["state", "seen", "desired", "control", "values", "active", "answer", "corner"]) told[name] = Array.from(flight[name]);
    found.calls.push({ ...told, way: Array.from(flight.way.slice(0, 30)) });
  };
  for (let i = 0; i < seconds && !flight.outcome; i++) {
    if (chosen.pilot === "keys") keys(flight, random);
    if (toggle && i === toggle) flight.filtered = !flight.filtered;
    if (calls) found.states.push(Array.from(flight.state));
    flight.second();
  }
  wasm.coast(task.ahead_steps);
  return {
    ...found, settings: flight.world.settings, time: flight.time, outcome: flight.outcome, broken: flight.broken, score: flight.score[0],
    deltaV: flight.deltaV, end: Array.from(flight.state), inspected: Array.from(flight.inspected), ahead: Array.from(flight.ahead),
    statuses: flight.calls, command: flight.command_again(), saved_state: flight.saved_state(),
    saved_controls: Buffer.from(flight.saved_controls()).toString("base64"),
  };
}

(async () => {
  const wasm = await loaded(inside("module").trim());
  const asked = JSON.parse(fs.readFileSync(0, "utf8"));
  process.stdout.write(JSON.stringify(asked.map(each => flown(wasm, each))));
})();
