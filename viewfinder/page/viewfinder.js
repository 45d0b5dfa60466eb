// Shows the stream: one frame at a time, each acknowledged when it is on the canvas, so that the next one is the newest.
"use strict";

const element = (id) => document.getElementById(id);
const canvas = element("picture");
const context = canvas.getContext("2d", { alpha: false });
const headerOf = new TextDecoder();

// Server time minus page time, from the exchange that took the least time (it cannot be more wrong than half of that).
const clock = { offset: 0, roundTrip: Infinity, asked: 0 };
const counts = { shown: 0, dropped: 0, last: null };
const recent = [];
window.viewfinder = { counts, clock, age: null, focus: null };

function distanceText(metres) {
  if (metres === null || metres > 100) return "∞";
  return metres < 1 ? `${(100 * metres).toFixed(0)} cm` : `${metres.toFixed(2)} m`;
}

function say(text) { element("message").textContent = text; }

function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/stream`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => {
    say("waiting for the camera");
    counts.last = null;
    clock.roundTrip = Infinity;
    askTime(socket);
  };
  socket.onmessage = (event) => (typeof event.data === "string" ? onText(JSON.parse(event.data)) : onFrame(socket, event.data));
  socket.onclose = () => {
    say("connection lost, trying again");
    setTimeout(connect, 1000);
  };
}

function askTime(socket) {
  if (socket.readyState !== WebSocket.OPEN) return;
  socket.send(JSON.stringify({ clock: performance.now() }));
  clock.asked += 1;
  setTimeout(askTime, clock.asked < 8 ? 150 : 5000, socket);
}

function onText(message) {
  if ("server_ms" in message) {
    const now = performance.now();
    const roundTrip = now - message.clock;
    // A little forgetting, because the clocks of two machines drift apart.
    clock.roundTrip += 0.01;
    if (roundTrip <= clock.roundTrip) {
      clock.roundTrip = roundTrip;
      clock.offset = message.server_ms - (message.clock + now) / 2;
    }
  } else if ("failure" in message) {
    say(message.failure);
  }
}

async function onFrame(socket, data) {
  const length = new DataView(data).getUint32(0);
  const header = JSON.parse(headerOf.decode(new Uint8Array(data, 4, length)));
  try {
    const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
    if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) {
      canvas.width = bitmap.width;
      canvas.height = bitmap.height;
    }
    context.drawImage(bitmap, 0, 0);
    bitmap.close();
    count(header);
  } finally {
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ ack: header.sequence }));
  }
}

function count(header) {
  const now = performance.now();
  if (counts.last !== null) counts.dropped += Math.max(0, header.sequence - counts.last - 1);
  counts.last = header.sequence;
  counts.shown += 1;
  recent.push(now);
  while (recent.length > 1 && recent[0] < now - 2000) recent.shift();
  window.viewfinder.age = now + clock.offset - header.captured_ms;
  window.viewfinder.focus = header.focus_distance_m;
  element("metres").classList.toggle("pending", header.focus_pending);
  if (counts.shown === 1 || element("message").textContent) say("");
}

function refreshReadout() {
  const { age } = window.viewfinder;
  if (age === null || clock.roundTrip === Infinity) return;
  element("age").textContent = Math.max(0, age).toFixed(0);
  const span = recent[recent.length - 1] - recent[0];
  element("fps").textContent = span > 0 ? (1000 * (recent.length - 1) / span).toFixed(1) : "-";
  element("dropped").textContent = counts.dropped;
}

// The slider is in dioptres (one over metres), in which blur grows evenly. One request at a time, the last position wins.
const asking = { busy: false, next: undefined };

async function askFocus(metres) {
  asking.next = metres;
  if (asking.busy) return;
  asking.busy = true;
  while (asking.next !== undefined) {
    const body = JSON.stringify({ focus_distance_m: asking.next });
    asking.next = undefined;
    try {
      const answer = await fetch("focus", { method: "POST", headers: { "Content-Type": "application/json" }, body });
      if (!answer.ok) say((await answer.json()).error);
    } catch {
      say("the focus could not be set");
    }
  }
  asking.busy = false;
}

async function start() {
  const state = await (await fetch("state")).json();
  const slider = element("focus");
  [slider.min, slider.max] = state.dioptre_range;
  slider.value = state.focus_distance_m === null ? 0 : 1 / state.focus_distance_m;
  slider.disabled = false;
  canvas.width = state.width_px;
  canvas.height = state.height_px;
  element("nearest").textContent = distanceText(1 / state.dioptre_range[1]);
  element("metres").textContent = distanceText(state.focus_distance_m);
  slider.addEventListener("input", () => {
    const dioptres = Number(slider.value);
    const metres = dioptres < 0.01 ? null : 1 / dioptres;
    element("metres").textContent = distanceText(metres);
    askFocus(metres);
  });
  setInterval(refreshReadout, 250);
  connect();
}

start().catch(() => say("the viewfinder does not answer"));
