// The page around the flight: its picture, keys, buttons, limits, numbers, and the clock that drives it.
"use strict";

const SPEEDS = [1, 2, 5, 10, 20, 50]; // seconds of flight per second
const MOST = 60; // most seconds of flight per picture
const KEYS = { // by key: thrust or torque, its axis, its sign
  w: ["thrust", 0, 1], s: ["thrust", 0, -1], a: ["thrust", 1, 1], d: ["thrust", 1, -1], r: ["thrust", 2, 1], f: ["thrust", 2, -1],
  q: ["torque", 0, -1], e: ["torque", 0, 1], arrowup: ["torque", 1, -1], arrowdown: ["torque", 1, 1],
  arrowleft: ["torque", 2, 1], arrowright: ["torque", 2, -1],
};
const STARTS = { 1: "ram", 2: "leaving", 3: "battery", 4: "random" };
const ENDS = {
  crash: ["Crash", "The deputy hit the chief."],
  out_of_bounds: ["Lost", "The deputy has left the zone, and does not come back."],
  out_of_power: ["Dead", "The battery is empty: no power, no command, no camera."],
  success: ["Done", "The chief is inspected."],
  timeout: ["Time is over", "Two orbits have passed."],
};

const $ = id => document.getElementById(id);
const task = JSON.parse($("data").textContent);
const pressed = new Set();
const play = { flight: null, scene: null, paused: true, speed: 10, ready: false, begun: 0 };

function clock(seconds) {
  return `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;
}

// the picture of the current flight
class Picture extends Scene {
  constructor(canvas, task) {
    super(canvas, { ...task, triangles: null, hull: null });
    this.ahead = this.line(COLOURS.ahead, 0.45, task.places);
    this.way = this.line(COLOURS.way, 1, task.places, 4);
    this.trail = this.line(COLOURS.trail, 0.8, task.max_time + 2);
  }

  begin(flight) {
    this.flownTo = 0;
    this.renew(flight);
  }

  // updates that follow each second of flight
  renew(flight) {
    const { inspected, lit, state, wasm } = flight;
    this.colour(Array.from(inspected, (seen, i) => (seen ? "inspected" : lit[i] ? "lit" : "dark")));
    const trail = this.trail.geometry.attributes.position;
    if (this.flownTo < trail.count) trail.setXYZ(this.flownTo++, state[0], state[1], state[2]);
    trail.needsUpdate = true;
    this.trail.geometry.setDrawRange(0, this.flownTo);
    wasm.coast(this.task.ahead_steps);
    this.fill(this.ahead, flight.ahead, this.task.places);
    this.fill(this.way, flight.way, flight.filtered ? wasm[`rest_${flight.filter}`]() : 0);
  }

  // `share`: of the way from the last state to the current one
  show(flight, share) {
    const { before, state, desired, control } = flight, x = mixed(before, state, share);
    const q = turned(before.slice(6, 10), state.slice(6, 10), share);
    this.draw({ p: x.slice(0, 3), q, sun: x[15], desired, control });
  }
}

// starts and switches

function begin(name = $("start").value) {
  const { starts } = play.flight, cases = starts.filter(each => each.name.startsWith("case"));
  const start = name === "random" ? cases[Math.floor(Math.random() * cases.length)] : starts.find(each => each.name === name) || cases[0];
  play.flight.begin(start, play.begun++ % task.worlds[0].plants.length);
  if (play.scene) play.scene.begin(play.flight);
  $("end").hidden = true;
  play.left = 0;
  show();
}

function set_filter(on) {
  play.flight.filtered = on;
  $("filter").setAttribute("aria-pressed", on);
  $("filter").innerHTML = `Safety filter ${on ? "ON" : "OFF"} <kbd>X</kbd>`;
  show();
}

// the filter with error bounds has its own period
function set_errors(worst) {
  play.flight.erring = worst;
  $("period").disabled = worst;
  $("period").value = worst ? task.worlds[1].period : play.flight.period;
  $("about-errors").hidden = !worst;
  begin();
}

function pause(still) {
  play.paused = still;
  $("pause").innerHTML = `${still ? "Go on" : "Pause"} <kbd>space</kbd>`;
}

function set_speed(place) {
  $("speed").value = place;
  play.speed = SPEEDS[$("speed").value];
  $("speed-value").textContent = `${play.speed} times`;
}

function next(id) {
  const select = $(id);
  select.selectedIndex = (select.selectedIndex + 1) % select.options.length;
  select.dispatchEvent(new Event("change"));
}

function welcomed() {
  if ($("welcome").hidden) return;
  $("welcome").hidden = true;
  pause(false);
}

function press(key, down) {
  if (!(key in KEYS)) return false;
  const { keys } = play.flight;
  if (down) pressed.add(key); else pressed.delete(key);
  keys.thrust.fill(0);
  keys.torque.fill(0);
  for (const each of pressed) {
    const [kind, axis, sign] = KEYS[each];
    keys[kind][axis] += sign;
  }
  if (down) $("pilot").value = play.flight.pilot = "you"; // pressing a key takes over the control
  if (down) welcomed();
  return true;
}

function on_key(event) {
  const key = event.key.toLowerCase(), down = event.type === "keydown", flight = play.flight;
  play.pointer = false;
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const typing = event.target.matches && event.target.matches("select, input, summary, button");
  if (typing && (key.startsWith("arrow") || key === " " || key === "enter") && $("welcome").hidden) return;
  const place = Number($("speed").value);
  if (press(key, down)) event.preventDefault();
  if (key in KEYS || !down || event.repeat) return;
  if (!$("welcome").hidden) {
    if (![" ", "enter", "escape"].includes(key)) return;
    welcomed();
  } else if (key === "x") set_filter(!flight.filtered);
  else if (key === " ") pause(!play.paused);
  else if (key === "n") begin();
  else if (key === "p") $("assistant").click();
  else if (key === "c") next("view");
  else if (key === "v") next("pilot");
  else if (key === "+" || key === "=") set_speed(Math.min(place + 1, SPEEDS.length - 1));
  else if (key === "-") set_speed(Math.max(place - 1, 0));
  else if (key in STARTS) begin($("start").value = STARTS[key]);
  else return;
  event.preventDefault();
}

function listen() {
  addEventListener("keydown", on_key);
  addEventListener("keyup", on_key);
  addEventListener("blur", () => { for (const key of [...pressed]) press(key, false); });
  // an element that was clicked must not keep the keyboard's focus
  addEventListener("pointerdown", () => { play.pointer = true; });
  addEventListener("change", event => { if (play.pointer) event.target.blur(); });
  addEventListener("click", event => { if (play.pointer && event.target.closest("button")) document.activeElement.blur(); });
  $("begin").onclick = welcomed;
  $("filter").onclick = () => set_filter(!play.flight.filtered);
  $("pause").onclick = () => pause(!play.paused);
  $("again").onclick = $("start").onchange = () => begin();
  $("pilot").onchange = () => { play.flight.pilot = $("pilot").value; play.flight.held.until = -1; };
  $("period").onchange = () => { play.flight.period = Number($("period").value); };
  if (task.worlds.length > 1) $("errors").onchange = () => set_errors($("errors").value === "worst");
  $("assistant").onchange = () => { play.flight.assistant = $("assistant").checked; };
  $("speed").oninput = () => set_speed($("speed").value);
  $("view").onchange = () => { if (play.scene) play.scene.view = $("view").value; };
  for (const button of document.querySelectorAll("#pad button")) {
    button.onpointerdown = event => { press(button.dataset.key, true); event.preventDefault(); };
    button.onpointerup = button.onpointercancel = button.onpointerleave = () => press(button.dataset.key, false);
    button.oncontextmenu = event => event.preventDefault();
  }
  $("save-settings").onclick = () => save("flight.toml", play.flight.world.settings);
  $("save-state").onclick = () => save("flight.json", play.flight.saved_state());
  $("save-controls").onclick = () => save("flight.npy", play.flight.saved_controls());
}

function save(name, content) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content]));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// display

function bars() {
  play.bars = task.limits.map(limit => {
    const bar = document.createElement("div");
    bar.className = "bar";
    bar.innerHTML = "<p><span></span><span></span></p><i></i>";
    bar.querySelector("span").textContent = limit.title;
    $("bars").append(bar);
    return bar;
  });
}

function show_bars(flight) {
  task.limits.forEach(({ scale, unit }, i) => {
    const bar = play.bars[i], h = flight.values[i], full = Math.max(0, Math.min(1, 1 - h / scale));
    bar.style.setProperty("--full", `${(100 * full).toFixed(1)}%`);
    bar.classList.toggle("close", full > 0.8);
    bar.classList.toggle("acts", flight.active[i] > 0);
    bar.classList.toggle("broken", !(h >= 0));
    const [size, digits] = unit === "%" ? [100 - 100 * full, 0] : unit === "\u00b0" ? [h * 180 / Math.PI, 0] : [h, h < 10 ? 2 : 0];
    bar.querySelectorAll("span")[1].textContent = h >= 0 ? `${size.toFixed(digits)} ${unit}` : "violated";
  });
}

function show_status(flight) {
  const [status, , backup] = flight.answer;
  const acting = task.limits.filter((_, i) => flight.active[i] > 0).map(limit => limit.title.toLowerCase());
  const because = acting.length ? ` because of: ${acting.slice(0, 2).join(", ")}` : "";
  const [kind, text] = !flight.filtered ? ["off", "The filter is off: every command is flown as it is."]
    : flight.missed ? ["corrected", "This call was missed: the last command is still flown."]
    : backup ? ["backup", `Backup: the deputy follows the way ${flight.worst ? "" : "to rest "}that was kept ready.`]
    : status === 0 ? ["", "Untouched: the command is safe and is flown as it is."]
    : status === 1 ? ["corrected", `Corrected${because || " to what the thrusters can do"}.`]
    : status === 2 ? ["backup", `A limit yields${because}.`]
    : ["backup", "No solution: the least bad command is flown."];
  $("status").className = kind;
  $("status").textContent = text;
}

function show_end(flight) {
  if (!flight.outcome) return;
  const [title, text] = ENDS[flight.outcome], good = flight.outcome === "success";
  $("end").className = good ? "success" : "";
  const fuel = good ? ` ${clock(flight.time)}, ${flight.deltaV.toFixed(1)} m/s of fuel.` : "";
  $("end").innerHTML = `<b>${title}</b>${text}${fuel}<br>Press <kbd>N</kbd> to fly again, <kbd>X</kbd> to switch the filter.`;
  $("end").hidden = false;
}

function show() {
  const { flight } = play, x = flight.state, calls = flight.calls.reduce((sum, each) => sum + each, 0);
  show_bars(flight);
  show_status(flight);
  show_end(flight);
  $("score").textContent = `${(100 * flight.score[0]).toFixed(0)} %`;
  $("delta-v").textContent = flight.deltaV.toFixed(2);
  $("time").textContent = clock(flight.time);
  $("distance").textContent = Math.hypot(x[0], x[1], x[2]).toFixed(0);
  $("moving").textContent = Math.hypot(x[3], x[4], x[5]).toFixed(2);
  $("calls").textContent = calls ? `${(100 * (1 - flight.calls[0] / calls)).toFixed(0)} %` : "\u2013";
  const broken = task.limits.filter(({ name }) => name in flight.broken).sort((a, b) => flight.broken[a.name] - flight.broken[b.name]);
  $("broken").replaceChildren(...broken.map(({ name, broken: text }) => {
    const item = document.createElement("li");
    item.textContent = `${clock(flight.broken[name])} ${text}`;
    return item;
  }));
  $("command").textContent = flight.command_again();
}

// the clock

function frame(now) {
  const { flight, scene } = play, passed = Math.min(0.25, (now - (play.last || now)) / 1000);
  play.last = now;
  if (!play.paused && !flight.outcome) {
    play.left += passed * play.speed;
    const count = Math.min(Math.floor(play.left), MOST);
    for (let i = 0; i < count; i++) {
      flight.second();
      if (scene) scene.renew(flight);
    }
    play.left -= Math.floor(play.left);
    if (count) show();
  }
  if (scene) scene.show(flight, flight.outcome ? 1 : play.left);
  requestAnimationFrame(frame);
}

async function main() {
  const three = document.createElement("script"); // packed, three.js has half the size
  three.textContent = new TextDecoder().decode(await unpacked($("three").textContent));
  document.head.append(three);
  play.flight = new Flight(await loaded($("module").textContent.trim()), task);
  try {
    play.scene = new Picture($("scene"), task);
  } catch (error) { // no WebGL here
    $("nothing").hidden = false;
  }
  bars();
  listen();
  begin();
  set_filter(true);
  set_speed(3);
  pause(true);
  play.ready = true;
  requestAnimationFrame(frame);
}

main();
