// Flies the page's own flight without a browser: node fly.js PAGE < flights.json > results.json
"use strict";
const fs = require("fs");
const vm = require("vm");

const page = fs.readFileSync(process.argv[2], "utf8");
const inside = id => page.match(new RegExp(`<script[^>]* id="${id}">([^]*?)</script>`))[1];
const source = [...page.matchAll(/<script>([^]*?)<\/script>/g)].map(found => found[1]).find(text => text.includes("class Flight"));
const { Flight, loaded, dice } = vm.runInThisContext(`(() => { ${source}\nreturn { Flight, loaded, dice }; })()`);
const task = JSON.parse(inside("data"));

// somebody who holds keys at random for up to 20 s
function keys(flight, random) {
  if (flight.time < (flight.until || 0)) return;
  flight.until = flight.time + Math.ceil(20 * random());
  for (const kind of ["thrust", "torque"]) {
    flight.keys[kind] = [0, 1, 2].map(() => Math.floor(3 * random()) - 1);
  }
  if (random() < 0.5) flight.keys.torque = [0, 0, 0]; // the assistant's turn
}

// plant: the number of the one that has the errors, where `erring`
function flown(wasm, { start, seconds, seed = 0, plant = 0, calls = false, toggle = 0, ...chosen }) {
  const flight = Object.assign(new Flight(wasm, task, seed), chosen, { until: 0 });
  const random = dice(seed + 1), found = { calls: [], states: [] };
  if (chosen.pilot === "keys") flight.pilot = "you";
  flight.begin(flight.starts.find(each => each.name === start), plant);
  const ask = wasm.ask, asking = (filter, on) => {
    const before = Array.from(flight.state), seen = Array.from(flight.seen), desired = Array.from(flight.desired), h = Array.from(flight.h);
    ask(filter, on);
    if (calls && on) {
      found.calls.push({
        state: before, seen, desired, h, missed: flight.missed, corner: Array.from(flight.corner), control: Array.from(flight.control), answer: Array.from(flight.answer),
        active: Array.from(flight.active), places: wasm.rest(filter), way: Array.from(flight.way.slice(0, 30)),
      });
    }
  };
  flight.wasm = { ...wasm, ask: asking };
  for (let i = 0; i < seconds && !flight.outcome; i++) {
    if (chosen.pilot === "keys") keys(flight, random);
    if (toggle && i === toggle) flight.filtered = !flight.filtered;
    if (calls) found.states.push(Array.from(flight.state));
    flight.second();
  }
  wasm.coast(task.ahead_steps);
  return {
    ...found, settings: flight.settings, time: flight.time, outcome: flight.outcome, broken: flight.broken, score: flight.score[0], deltaV: flight.deltaV,
    end: Array.from(flight.state), inspected: Array.from(flight.inspected), ahead: Array.from(flight.ahead),
    statuses: flight.calls, command: flight.command_again(), saved_state: flight.saved_state(), saved_controls: Buffer.from(flight.saved_controls()).toString("base64"),
  };
}

(async () => {
  const wasm = await loaded(inside("module").trim());
  const asked = JSON.parse(fs.readFileSync(0, "utf8"));
  process.stdout.write(JSON.stringify(asked.map(each => flown(wasm, each))));
})();
