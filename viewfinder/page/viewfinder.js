// Built from viewfinder/page_source by `npm run build`; do not edit. sources: d2a670ebeedf50d40ef699754eaeeb931f6de2d94831300557e7e2c9283c6821
"use strict";
(() => {
  // src/model.ts
  var NOTICE_S = 10;
  var Model = class extends EventTarget {
    state = null;
    shown = null;
    way = "";
    sentence = "";
    silence = 0;
    failing = false;
    noticed = 0;
    setState(state) {
      this.state = state;
      this.dispatchEvent(new Event("state"));
      const unseen = (state.notices ?? []).filter((each) => each.number > this.noticed);
      if (unseen.length === 0) return;
      this.noticed = Math.max(...unseen.map((each) => each.number));
      this.say(unseen.map((each) => each.sentence).join(" · "), NOTICE_S);
    }
    show(frame) {
      this.shown = frame;
      if (this.failing) this.say("");
      this.dispatchEvent(new Event("frame"));
    }
    setWay(way) {
      this.way = way;
      this.dispatchEvent(new Event("way"));
    }
    /** Show a sentence; forSeconds null keeps it until another one comes. */
    say(sentence, forSeconds = null) {
      clearTimeout(this.silence);
      this.failing = false;
      this.sentence = sentence;
      this.dispatchEvent(new Event("sentence"));
      if (forSeconds !== null) this.silence = window.setTimeout(() => this.say(""), 1e3 * forSeconds);
    }
    /** The stream stands still for a reason, until the next picture. */
    fail(sentence) {
      this.say(sentence);
      this.failing = true;
    }
    get mayControl() {
      return this.state?.role === "control";
    }
  };
  var model = new Model();
  function distanceText(metres) {
    if (metres === null || metres > 100) return "∞";
    return metres < 1 ? `${(100 * metres).toFixed(0)} cm` : `${metres.toFixed(2)} m`;
  }

  // src/aids.ts
  var AIDS = {
    peakReal: "peaking: real",
    peakVirtual: "peaking: virtual",
    zebra: "zebra",
    histogram: "histogram",
    grid: "grid",
    level: "level of this phone",
    times: "times",
    leftHand: "left hand"
  };
  var KEPT = "mrbokeh-aids";
  var Aids = class extends EventTarget {
    on = new Set(load());
    has(aid) {
      return this.on.has(aid);
    }
    set(aid, on) {
      if (on) this.on.add(aid);
      else this.on.delete(aid);
      try {
        localStorage.setItem(KEPT, JSON.stringify([...this.on]));
      } catch {
      }
      this.dispatchEvent(new Event("change"));
    }
  };
  function load() {
    try {
      const kept = JSON.parse(localStorage.getItem(KEPT) ?? "[]");
      return Array.isArray(kept) ? kept.filter((each) => each in AIDS) : [];
    } catch {
      return [];
    }
  }
  var aids = new Aids();
  var levelAllowed = window.isSecureContext && "DeviceOrientationEvent" in window;
  async function askForLevel() {
    const kind = DeviceOrientationEvent;
    return !kind.requestPermission || await kind.requestPermission().catch(() => "denied") === "granted";
  }
  function upOnScreen(beta, gamma, screen2) {
    const [b, g, s] = [beta, gamma, screen2].map((angle) => angle * Math.PI / 180);
    const [x, y, z] = [-Math.cos(b) * Math.sin(g), Math.sin(b), Math.cos(b) * Math.cos(g)];
    return [x * Math.cos(s) - y * Math.sin(s), x * Math.sin(s) + y * Math.cos(s), z];
  }
  function showLevel(line, active) {
    if (!levelAllowed) return;
    window.addEventListener("deviceorientation", (event) => {
      line.hidden = !active() || event.beta === null || event.gamma === null;
      if (line.hidden) return;
      const [right, up, towards] = upOnScreen(event.beta, event.gamma, screen.orientation?.angle ?? 0);
      const roll = Math.atan2(right, up) * 180 / Math.PI;
      const down = Math.asin(Math.max(-1, Math.min(1, towards))) / (Math.PI / 2);
      line.style.transform = `translateY(${-100 * down}%) rotate(${roll}deg)`;
      line.classList.toggle("even", Math.abs(roll) < 0.7);
    });
  }
  var AidSwitches = class extends HTMLElement {
    connectedCallback() {
      this.innerHTML = "<details><summary>Aids</summary><div></div></details>";
      for (const aid of Object.keys(AIDS)) {
        if (aid === "level" && !levelAllowed) continue;
        const button2 = document.createElement("button");
        button2.id = `aid_${aid}`;
        button2.textContent = AIDS[aid];
        button2.addEventListener("click", () => aids.set(aid, !aids.has(aid)));
        this.querySelector("div").append(button2);
      }
      aids.addEventListener("change", () => this.refresh());
      model.addEventListener("state", () => this.refresh());
      this.refresh();
    }
    refresh() {
      for (const aid of Object.keys(AIDS)) this.querySelector(`#aid_${aid}`)?.setAttribute("aria-pressed", String(aids.has(aid)));
      document.body.classList.toggle("left-hand", aids.has("leftHand"));
      const apart = model.state?.matte === true;
      this.querySelector("#aid_peakVirtual").hidden = !apart;
      this.querySelector("#aid_peakReal").textContent = apart ? AIDS.peakReal : "peaking";
    }
  };

  // src/server.ts
  var ANSWER_S = 6;
  var PACE_MS = 50;
  var pace = () => new Promise((done) => setTimeout(done, PACE_MS));
  async function enter() {
    const token = new URLSearchParams(location.hash.slice(1)).get("token");
    if (token === null) return;
    history.replaceState(null, "", location.pathname + location.search);
    const answer = await fetch("/enter", posted({ token }));
    if (!answer.ok && (await fetch("/state")).status === 401) throw new Error(await sentenceOf(answer));
  }
  async function refreshState() {
    const answer = await fetch("/state");
    if (!answer.ok) throw new Error(await sentenceOf(answer));
    const state = await answer.json();
    model.setState(state);
    return state;
  }
  async function control(message) {
    try {
      const answer = await fetch("/control", posted(message));
      const body = await answer.json();
      if (body.error === void 0) return body;
      model.say(body.error, ANSWER_S);
    } catch {
      model.say("the viewfinder does not answer", ANSWER_S);
    }
    return null;
  }
  var latest = /* @__PURE__ */ new Map();
  async function controlLatest(kind, message) {
    const busy = latest.get(kind);
    if (busy) {
      busy.next = message;
      return;
    }
    const turn = { next: message };
    latest.set(kind, turn);
    while (turn.next) {
      const now = turn.next;
      turn.next = null;
      await control(now);
      await pace();
    }
    latest.delete(kind);
  }
  async function sentenceOf(answer) {
    const text = await answer.text();
    try {
      return JSON.parse(text).error ?? answer.statusText;
    } catch {
      return text.slice(0, 200) || `the viewfinder answered ${answer.status}`;
    }
  }
  function posted(message) {
    return { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message) };
  }
  var GATHERING_MS = 1e3;
  async function offerTo(path2, peer) {
    await peer.setLocalDescription();
    await gathered(peer);
    const body = peer.localDescription.sdp;
    if (!body.includes("a=candidate:")) throw new Error("this browser has no network address for video");
    const answer = await fetch(path2, { method: "POST", headers: { "Content-Type": "application/sdp" }, body });
    if (!answer.ok) throw new Error(await sentenceOf(answer));
    await peer.setRemoteDescription({ type: "answer", sdp: await answer.text() });
    return answer.headers.get("Location");
  }
  function release(resource) {
    if (resource !== null) void fetch(resource, { method: "DELETE", keepalive: true }).catch(() => void 0);
  }
  function gathered(peer) {
    return new Promise((done) => {
      if (peer.iceGatheringState === "complete") return done();
      setTimeout(done, GATHERING_MS);
      peer.addEventListener("icegatheringstatechange", () => peer.iceGatheringState === "complete" && done());
    });
  }

  // src/gallery.ts
  var ANSWER_S2 = 6;
  var SURE_MS = 4e3;
  var Gallery = class extends HTMLElement {
    dialog;
    list;
    connectedCallback() {
      this.innerHTML = `<button id="open_gallery" hidden>Saved</button>
      <dialog id="gallery" aria-label="saved takes and captures">
        <header><h2>Saved</h2><span id="room"></span><button id="close_gallery">Close</button></header>
        <div id="playing"></div>
        <ul id="saved"></ul>
      </dialog>`;
      this.dialog = this.querySelector("#gallery");
      this.list = this.querySelector("#saved");
      this.querySelector("#open_gallery").addEventListener("click", () => void this.open());
      this.querySelector("#close_gallery").addEventListener("click", () => this.dialog.close());
      this.dialog.addEventListener("close", () => this.querySelector("#playing").replaceChildren());
      model.addEventListener("state", () => this.querySelector("#open_gallery").hidden = model.state?.gallery !== true);
    }
    async open() {
      if (await this.refresh()) this.dialog.showModal();
    }
    /** Whether the server gave a list. */
    async refresh() {
      const answer = await fetch("/gallery").catch(() => null);
      if (!answer?.ok) {
        model.say(answer ? await sentenceOf(answer) : "the viewfinder does not answer", ANSWER_S2);
        return false;
      }
      const { saved: all, free_bytes } = await answer.json();
      this.querySelector("#room").textContent = `${(free_bytes / 1e9).toFixed(1)} GB free`;
      this.list.replaceChildren(...all.map((each) => this.entry(each)));
      if (all.length === 0) this.list.textContent = "Nothing was saved yet: the red button records, the white one captures.";
      return true;
    }
    entry(listed) {
      const entry = document.createElement("li");
      const small = document.createElement("img");
      small.loading = "lazy";
      small.alt = "";
      small.src = path(listed, "small");
      const play = button(listed.kind === "take" ? "Play" : "Show", () => this.show(listed));
      const keep = document.createElement("a");
      keep.href = path(listed, "file");
      keep.download = "";
      keep.textContent = "Download";
      const words = document.createElement("p");
      words.textContent = [listed.name, length(listed.length_s), megabytes(listed.size_bytes)].filter(Boolean).join(" · ");
      const remove = button("Delete", () => void this.erase(listed, remove));
      for (const each of [play, keep, remove]) each.setAttribute("aria-label", `${each.textContent} ${listed.name}`);
      entry.append(small, words, play, keep, remove);
      return entry;
    }
    show(listed) {
      const shown = document.createElement(listed.kind === "take" ? "video" : "img");
      shown.src = path(listed, "shown");
      if (shown instanceof HTMLVideoElement) Object.assign(shown, { controls: true, autoplay: true, playsInline: true, muted: true });
      else shown.alt = `capture ${listed.name}`;
      this.querySelector("#playing").replaceChildren(shown);
      this.dialog.scrollTo(0, 0);
    }
    /** At the second press: what is deleted is gone. */
    async erase(listed, pressed) {
      if (pressed.dataset["sure"] === void 0) {
        pressed.dataset["sure"] = "";
        pressed.textContent = "Really?";
        setTimeout(() => {
          delete pressed.dataset["sure"];
          pressed.textContent = "Delete";
        }, SURE_MS);
        return;
      }
      this.querySelector("#playing").replaceChildren();
      const answer = await fetch(path(listed, ""), { method: "DELETE" }).catch(() => null);
      if (!answer?.ok) model.say(answer ? await sentenceOf(answer) : "the viewfinder does not answer", ANSWER_S2);
      await this.refresh();
    }
  };
  function path(listed, what) {
    return `/gallery/${encodeURIComponent(listed.name)}${what && "/"}${what}`;
  }
  function button(text, press) {
    const made = document.createElement("button");
    made.textContent = text;
    made.addEventListener("click", press);
    return made;
  }
  function length(length_s) {
    return length_s === null ? "" : `${Math.floor(length_s / 60)}:${String(Math.round(length_s) % 60).padStart(2, "0")}`;
  }
  function megabytes(size_bytes) {
    return `${(size_bytes / 1e6).toFixed(1)} MB`;
  }

  // src/timing.ts
  var ServerClock = class {
    offset_ms = 0;
    roundTrip_ms = Infinity;
    asked = 0;
    timer = 0;
    /** Ask through a channel, often at first; `answer` takes what comes back. */
    start(send) {
      this.stop();
      this.roundTrip_ms = Infinity;
      this.asked = 0;
      const ask = () => {
        send(JSON.stringify({ clock: performance.now() }));
        this.asked += 1;
        this.timer = window.setTimeout(ask, this.asked < 8 ? 150 : 5e3);
      };
      ask();
    }
    answer(message) {
      const now = performance.now();
      const roundTrip_ms = now - message.clock;
      this.roundTrip_ms += 0.01;
      if (roundTrip_ms <= this.roundTrip_ms) {
        this.roundTrip_ms = roundTrip_ms;
        this.offset_ms = message.server_ms - (message.clock + now) / 2;
      }
    }
    stop() {
      clearTimeout(this.timer);
    }
    get known() {
      return this.roundTrip_ms < Infinity;
    }
  };
  var clock = new ServerClock();
  var SPAN_MS = 2e3;
  var Counts = class {
    shown = 0;
    dropped = 0;
    age_ms = null;
    last = null;
    times = [];
    /** A new connection: the gap to the last picture is nobody's drop. */
    restart() {
      this.last = null;
      this.times.length = 0;
    }
    /** A picture is on the screen since shown_ms of the page's time. */
    count(shown_ms) {
      this.shown += 1;
      this.times.push(shown_ms);
      while (this.times.length > 1 && this.times[0] < shown_ms - SPAN_MS) this.times.shift();
    }
    /** What is known of a picture that was shown at shown_ms. */
    know(header, shown_ms) {
      if (this.last !== null) this.dropped += Math.max(0, header.sequence - this.last - 1);
      this.last = header.sequence;
      this.age_ms = shown_ms + clock.offset_ms - header.captured_ms;
    }
    get fps() {
      const span = this.times[this.times.length - 1] - this.times[0];
      return span > 0 ? 1e3 * (this.times.length - 1) / span : null;
    }
  };
  var counts = new Counts();

  // src/panel.ts
  var CHOICES = [
    { id: "view", label: "View", names: (s) => s.views ?? [], now: (s) => s.view, message: (view) => ({ view }) },
    { id: "lens", label: "Lens", names: (s) => s.lenses ?? [], now: (s) => s.lens, message: (lens) => ({ lens }) },
    {
      id: "f_number",
      label: "Aperture",
      names: (s) => (s.f_numbers ?? []).map(String),
      now: (s) => s.f_number === void 0 ? void 0 : String(s.f_number),
      message: (text) => ({ f_number: Number(text) }),
      shown: (text) => `f/${Number(text).toFixed(1)}`
    },
    { id: "renderer", label: "Renderer", names: (s) => s.renderers ?? [], now: (s) => s.renderer, message: (renderer) => ({ renderer }) }
  ];
  var Choices = class extends HTMLElement {
    lastView = "plate";
    connectedCallback() {
      for (const choice of CHOICES) this.append(this.picker(choice));
      const button2 = document.createElement("button");
      button2.id = "ab";
      button2.textContent = "A/B";
      button2.title = "back to the view before this one";
      button2.addEventListener("click", () => void this.choose(CHOICES[0], this.lastView));
      this.querySelector("#view").after(button2);
      model.addEventListener("state", () => this.onState());
    }
    picker(choice) {
      const label = document.createElement("label");
      label.append(choice.label);
      const select = document.createElement("select");
      select.id = choice.id;
      select.addEventListener("change", () => void this.choose(choice, select.value));
      label.append(select);
      return label;
    }
    async choose(choice, name) {
      const before = model.state?.view;
      const answer = await control(choice.message(name));
      if (answer && choice.id === "view" && before && before !== name) this.lastView = before;
      await refreshState().catch(() => void 0);
    }
    onState() {
      const state = model.state;
      for (const choice of CHOICES) {
        const select = this.querySelector(`#${choice.id}`);
        const now = choice.now(state);
        const names = [.../* @__PURE__ */ new Set([...choice.names(state), ...now === void 0 ? [] : [now]])];
        if (select.dataset["names"] !== names.join("\n")) {
          select.replaceChildren(...names.map((name) => new Option(choice.shown?.(name) ?? name, name)));
          select.dataset["names"] = names.join("\n");
        }
        if (now !== void 0 && document.activeElement !== select) select.value = now;
        select.parentElement.hidden = choice.names(state).length === 0;
        select.disabled = !model.mayControl;
      }
      const button2 = this.querySelector("#ab");
      button2.disabled = !model.mayControl || !state.views?.includes(this.lastView);
    }
  };
  var selection = { name: "" };
  var ObjectPicker = class extends HTMLElement {
    connectedCallback() {
      this.innerHTML = `<label>Object<select id="object"></select></label>
      <label class="switch"><input id="visible" type="checkbox"> shown</label>
      <label class="switch" id="smooth_label"><input id="smoothing" type="checkbox"> smooth tracking</label>`;
      this.find("object").addEventListener("change", () => this.onPick());
      this.find("visible").addEventListener("change", () => void this.send({ object: { name: selection.name, visible: this.find("visible").checked } }));
      this.find("smoothing").addEventListener("change", () => void this.send({ smoothing: this.find("smoothing").checked }));
      model.addEventListener("state", () => this.onState());
    }
    find(id) {
      return this.querySelector(`#${id}`);
    }
    onPick() {
      selection.name = this.find("object").value;
      if (selection.name) model.say(`drag ${selection.name} on the picture`, 3);
      this.onState();
    }
    async send(message) {
      await control(message);
      await refreshState().catch(() => void 0);
    }
    onState() {
      const { objects = [], smoothing } = model.state;
      const select = this.find("object");
      const names = objects.map((each) => each.name);
      if (!names.includes(selection.name)) selection.name = "";
      if (select.dataset["names"] !== names.join("\n")) {
        select.replaceChildren(new Option("none", ""), ...names.map((name) => new Option(name, name)));
        select.dataset["names"] = names.join("\n");
      }
      select.value = selection.name;
      select.parentElement.hidden = names.length === 0;
      const picked = objects.find((each) => each.name === selection.name);
      this.find("visible").parentElement.hidden = !picked;
      this.find("visible").checked = picked?.visible ?? false;
      this.find("smooth_label").hidden = typeof smoothing !== "boolean";
      this.find("smoothing").checked = smoothing === true;
      for (const id of ["object", "visible", "smoothing"]) this.find(id).disabled = !model.mayControl;
    }
  };
  var INFINITY_BELOW = 0.01;
  var QUIET_MS = 1500;
  var FocusControl = class extends HTMLElement {
    slider;
    metres;
    touched_ms = -Infinity;
    connectedCallback() {
      this.innerHTML = `<label for="focus">Focus <span id="focus_from"></span><output id="metres" for="focus">-</output></label>
      <input id="focus" type="range" min="0" max="1" step="any" disabled>
      <div class="ends"><span>∞</span><span id="nearest"></span></div>`;
      this.slider = this.querySelector("#focus");
      this.metres = this.querySelector("#metres");
      this.slider.addEventListener("input", () => this.ask());
      model.addEventListener("state", () => this.onState());
      model.addEventListener("frame", () => this.onFrame());
    }
    ask() {
      this.touched_ms = performance.now();
      const dioptres = Number(this.slider.value);
      const distance_m = dioptres < INFINITY_BELOW ? null : 1 / dioptres;
      this.metres.textContent = distanceText(distance_m);
      void controlLatest("focus", { focus: { distance_m } });
    }
    onState() {
      const { dioptre_range, focus_distance_m } = model.state;
      this.hidden = dioptre_range === void 0;
      this.querySelector("#focus_from").textContent = toldBy(model.state.focus_from);
      if (dioptre_range === void 0) return;
      [this.slider.min, this.slider.max] = dioptre_range.map(String);
      this.slider.disabled = !model.mayControl;
      this.querySelector("#nearest").textContent = distanceText(1 / dioptre_range[1]);
      if (focus_distance_m !== void 0 && model.shown === null) this.follow(focus_distance_m);
    }
    onFrame() {
      const header = model.shown.header;
      if (header?.focus_distance_m === void 0) return;
      this.metres.classList.toggle("pending", header.focus_pending === true);
      if (!header.focus_pending) this.follow(header.focus_distance_m);
    }
    /** Show what somebody else set, unless a finger is on the slider. */
    follow(distance_m) {
      if (performance.now() - this.touched_ms < QUIET_MS) return;
      this.slider.value = String(distance_m === null ? 0 : 1 / distance_m);
      this.metres.textContent = distanceText(distance_m);
    }
  };
  function toldBy(name) {
    if (name === void 0) return "";
    return name === null ? "from the file of the lens" : name.startsWith("by ") ? name : `from ${name}`;
  }
  var SHORT_OF_ROOM_S = 300;
  var Shutter = class extends HTMLElement {
    began_ms = 0;
    connectedCallback() {
      this.innerHTML = `<output id="timer" aria-live="off" hidden></output>
      <button id="record" aria-label="record" aria-pressed="false"></button>
      <button id="capture" aria-label="capture"></button>`;
      this.button("capture").addEventListener("click", () => void this.capture());
      this.button("record").addEventListener("click", () => void this.record());
      model.addEventListener("state", () => this.onState());
      setInterval(() => this.showTime(), 250);
    }
    button(id) {
      return this.querySelector(`#${id}`);
    }
    async capture() {
      this.button("capture").disabled = true;
      model.say("capturing");
      const answer = await control({ capture: {} });
      if (answer) model.say(`saved ${String(answer["bundle"])}`, 5);
      this.onState();
    }
    async record() {
      await control({ record: !model.state?.recording });
      await refreshState().catch(() => void 0);
    }
    onState() {
      const { can_capture, can_record, recording, recorded_s } = model.state;
      this.began_ms = performance.now() - 1e3 * (recorded_s ?? 0);
      document.body.classList.toggle("recording", recording === true);
      this.showTime();
      this.button("capture").hidden = !can_capture;
      this.button("record").hidden = !can_record;
      this.button("capture").disabled = this.button("record").disabled = !model.mayControl;
      this.button("record").setAttribute("aria-pressed", String(recording === true));
      this.hidden = !can_capture && !can_record;
    }
    /** How long the take is, and how much longer the disk will do where that is not long. */
    showTime() {
      const { recording, room_s } = model.state ?? {};
      const timer = this.querySelector("#timer");
      timer.hidden = recording !== true;
      const short = room_s !== void 0 && room_s !== null && room_s < SHORT_OF_ROOM_S;
      timer.textContent = minutes(performance.now() - this.began_ms) + (short ? ` · disk full in ${minutes(1e3 * room_s)}` : "");
      timer.classList.toggle("short", short);
    }
  };
  function minutes(time_ms) {
    const seconds = Math.floor(time_ms / 1e3);
    return `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}`;
  }
  var WAYS = { whep: "video", jpeg: "pictures" };
  var Readout = class extends HTMLElement {
    connectedCallback() {
      this.innerHTML = `<div><b id="age">-</b><span>ms old</span></div>
      <div><b id="fps">-</b><span>frames/s</span></div>
      <div><b id="dropped">0</b><span>dropped</span></div>
      <div><b id="way">-</b><span>sent as</span></div>
      <p id="times" hidden></p>`;
      setInterval(() => this.refresh(), 250);
    }
    refresh() {
      const set = (id, text) => {
        this.querySelector(`#${id}`).textContent = text;
      };
      if (counts.age_ms !== null && clock.known) set("age", Math.max(0, counts.age_ms).toFixed(0));
      set("fps", counts.fps?.toFixed(1) ?? "-");
      set("dropped", String(counts.dropped));
      set("way", WAYS[model.way] ?? "-");
      const header = model.shown?.header;
      const stages = Object.entries(header?.stages_ms ?? {}).map(([name, took_ms]) => `${name} ${took_ms.toFixed(1)}`);
      if (header?.layer_age_ms) stages.push(`layer ${header.layer_age_ms.toFixed(0)} old`);
      set("times", stages.length ? `${stages.join(" · ")} ms` : "");
      this.querySelector("#times").hidden = !aids.has("times");
    }
  };

  // src/gestures.ts
  var TAP_PX = 10;
  var TWICE_MS = 300;
  function listen(element, gestures) {
    const zoom = (factor, x, y, dx, dy) => gestures.zoom ? gestures.zoom(factor, x, y, dx, dy) : gestures.pinch(factor, x, y, dx, dy, 0);
    const fingers = /* @__PURE__ */ new Map();
    let start2 = { x: 0, y: 0 };
    let kind = "none";
    let lastTap_ms = -Infinity;
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (kind === "drag") gestures.dragEnd(true);
      start2 = { x: event.clientX, y: event.clientY };
      kind = fingers.size > 1 ? "pinch" : event.button === 1 ? "move" : "tap";
    });
    element.addEventListener("pointermove", (event) => {
      const finger = fingers.get(event.pointerId);
      if (!finger) return;
      const before = [...fingers.values()].map((each) => ({ ...each }));
      const [dx, dy] = [event.clientX - finger.x, event.clientY - finger.y];
      [finger.x, finger.y] = [event.clientX, event.clientY];
      if (kind === "tap" && Math.hypot(finger.x - start2.x, finger.y - start2.y) > TAP_PX) {
        kind = "drag";
        gestures.dragStart(start2.x, start2.y);
        gestures.drag(finger.x, finger.y, finger.x - start2.x, finger.y - start2.y);
      } else if (kind === "drag") {
        gestures.drag(finger.x, finger.y, dx, dy);
      } else if (kind === "move") {
        zoom(1, finger.x, finger.y, dx, dy);
      } else if (kind === "pinch" && fingers.size === 2) {
        const [a, b] = [...fingers.values()];
        const [c, d] = before;
        const factor = Math.hypot(a.x - b.x, a.y - b.y) / Math.max(1, Math.hypot(c.x - d.x, c.y - d.y));
        const turned = Math.atan2(b.y - a.y, b.x - a.x) - Math.atan2(d.y - c.y, d.x - c.x);
        gestures.pinch(factor, (a.x + b.x) / 2, (a.y + b.y) / 2, dx / 2, dy / 2, (turned * 180 / Math.PI + 540) % 360 - 180);
      }
    });
    const end = (event) => {
      if (!fingers.delete(event.pointerId)) return;
      if (kind === "drag") gestures.dragEnd(false);
      if (kind === "tap" && event.type === "pointerup") {
        if (event.timeStamp - lastTap_ms < TWICE_MS) gestures.twice(event.clientX, event.clientY);
        else gestures.tap(event.clientX, event.clientY);
        lastTap_ms = event.timeStamp;
      }
      if (kind !== "pinch" || fingers.size === 0) kind = "none";
    };
    element.addEventListener("pointerup", end);
    element.addEventListener("pointercancel", end);
    element.addEventListener("wheel", (event) => {
      event.preventDefault();
      const factor = Math.exp(-event.deltaY / 400);
      if (event.ctrlKey || event.metaKey) zoom(Math.abs(event.deltaY) < 50 ? factor ** 4 : factor, event.clientX, event.clientY, 0, 0);
      else if (gestures.wheel) gestures.wheel(factor, event.deltaX / 8);
      else gestures.pinch(factor, event.clientX, event.clientY, 0, 0, event.deltaX / 8);
    }, { passive: false });
  }
  var MOST = 8;
  var Zoom = class {
    constructor(frame, stage) {
      this.frame = frame;
      this.stage = stage;
    }
    frame;
    stage;
    scale = 1;
    left_px = 0;
    top_px = 0;
    by(factor, x_px, y_px, dx_px, dy_px) {
      const scale = Math.min(MOST, Math.max(1, this.scale * factor));
      const box = this.frame.getBoundingClientRect();
      const [x, y] = [x_px - box.left, y_px - box.top];
      this.left_px = x - (x - this.left_px) * scale / this.scale + dx_px;
      this.top_px = y - (y - this.top_px) * scale / this.scale + dy_px;
      this.scale = scale;
      this.apply();
    }
    pan(dx_px, dy_px) {
      this.left_px += dx_px;
      this.top_px += dy_px;
      this.apply();
    }
    reset() {
      [this.scale, this.left_px, this.top_px] = [1, 0, 0];
      this.apply();
    }
    apply() {
      const { clientWidth, clientHeight } = this.stage;
      this.left_px = Math.min(0, Math.max(clientWidth * (1 - this.scale), this.left_px));
      this.top_px = Math.min(0, Math.max(clientHeight * (1 - this.scale), this.top_px));
      this.stage.style.transform = `translate(${this.left_px}px, ${this.top_px}px) scale(${this.scale})`;
    }
  };
  function onGround([m0, m1, m2], [x, y]) {
    const of = ([a, b, c]) => a * x + b * y + c;
    const w = of(m2);
    return Math.abs(w) < 1e-9 ? null : [of(m0) / w, of(m1) / w];
  }
  var ObjectDrag = class {
    constructor(name, from) {
      this.name = name;
      this.from = from;
      void this.begin();
    }
    name;
    from;
    ground = null;
    sent = null;
    wanted = null;
    busy = false;
    moveTo(point) {
      this.wanted = point;
      void this.send();
    }
    /** The plane as it lies now: the camera may have moved since the last state. */
    async begin() {
      const state = await refreshState().catch(() => null);
      this.ground = state?.ground_from_picture ?? null;
      this.sent = this.ground && onGround(this.ground, this.from);
      if (!this.sent) model.say("an object can be moved while the camera is tracked and sees the ground", 6);
      void this.send();
    }
    async send() {
      if (this.busy || !this.ground) return;
      this.busy = true;
      while (this.wanted && this.sent) {
        const to = onGround(this.ground, this.wanted);
        this.wanted = null;
        if (!to) continue;
        const answer = await control({ object: { name: this.name, move_m: [to[0] - this.sent[0], to[1] - this.sent[1]] } });
        if (!answer) break;
        this.sent = to;
        await pace();
      }
      this.busy = false;
    }
  };

  // src/marks.ts
  var VERTEX = `#version 300 es
out vec2 at;
void main() {
  vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  at = vec2(0.5 + 0.5 * corner.x, 0.5 - 0.5 * corner.y);
  gl_Position = vec4(corner, 0.0, 1.0);
}`;
  var FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D picture, matte;
uniform vec2 step_uv;
uniform vec3 wanted;  // peaking of the real, of the virtual, zebra: 1 or 0
uniform bool measuring;
in vec2 at;
out vec4 color;
float luma(float x, float y) { return dot(texture(picture, at + step_uv * vec2(x, y)).rgb, vec3(0.2126, 0.7152, 0.0722)); }
float across(float x) { return 0.25 * luma(x, -1.0) + 0.5 * luma(x, 0.0) + 0.25 * luma(x, 1.0); }
float down(float y) { return 0.25 * luma(-1.0, y) + 0.5 * luma(0.0, y) + 0.25 * luma(1.0, y); }
void main() {
  float here = luma(0.0, 0.0);
  if (measuring) { color = vec4(here, 0.0, 0.0, 1.0); return; }
  float fine = length(vec2(across(1.0) - across(-1.0), down(1.0) - down(-1.0)));
  vec4 far = vec4(luma(3.0, 0.0), luma(-3.0, 0.0), luma(0.0, 3.0), luma(0.0, -3.0));
  vec4 diagonal = vec4(luma(2.0, 2.0), luma(-2.0, -2.0), luma(2.0, -2.0), luma(-2.0, 2.0));
  vec4 low = min(far, diagonal), high = max(far, diagonal);
  float contrast = max(max(high.x, high.y), max(high.z, high.w)) - min(min(low.x, low.y), min(low.z, low.w));
  bool is_virtual = texture(matte, at).r >= 0.5;
  color = vec4(0.0);
  bool focused = fine > min(0.35, max(0.1, 0.6 * contrast));
  if (focused && (is_virtual ? wanted.y : wanted.x) > 0.5) color = is_virtual ? vec4(1.0, 0.1, 0.9, 1.0) : vec4(0.2, 1.0, 0.2, 1.0);
  else if (wanted.z > 0.5 && here > 0.95 && mod(gl_FragCoord.x + gl_FragCoord.y, 8.0) < 4.0) color = vec4(0.0, 0.0, 0.0, 0.8);
}`;
  var BINS = 64;
  var MEASURED = { width: 96, height: 54 };
  var Marks = class _Marks {
    constructor(canvas, gl) {
      this.canvas = canvas;
      this.gl = gl;
      this.program = program(gl);
      this.picture = texture(gl, gl.LINEAR);
      this.matte = texture(gl, gl.LINEAR);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      const target = texture(gl, gl.NEAREST);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, MEASURED.width, MEASURED.height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
      this.small = gl.createFramebuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.small);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
    }
    canvas;
    gl;
    program;
    picture;
    matte;
    small;
    read = new Uint8Array(4 * MEASURED.width * MEASURED.height);
    /** Null where the browser has no WebGL2. */
    static on(canvas) {
      const gl = canvas.getContext("webgl2", { premultipliedAlpha: true, antialias: false, depth: false });
      return gl ? new _Marks(canvas, gl) : null;
    }
    setMatte(matte) {
      this.upload(this.matte, matte);
    }
    /** Draw the marks of a picture over it. */
    draw(pixels, marking) {
      const [width, height] = sizeOf(pixels);
      if (!width || !height) return;
      if (this.canvas.width !== width || this.canvas.height !== height) [this.canvas.width, this.canvas.height] = [width, height];
      this.upload(this.picture, pixels);
      this.pass(null, width, height, marking);
    }
    /** How many of the picture's pixels have each luma, darkest first, of the picture drawn last; the highest bin is 1. */
    histogram() {
      const { width, height } = MEASURED;
      this.pass(this.small, width, height, { peakReal: false, peakVirtual: false, zebra: false });
      this.gl.readPixels(0, 0, width, height, this.gl.RGBA, this.gl.UNSIGNED_BYTE, this.read);
      const bins = new Array(BINS).fill(0);
      for (let i = 0; i < this.read.length; i += 4) bins[this.read[i] * BINS >> 8] += 1;
      const highest = Math.max(...bins);
      return bins.map((count) => count / highest);
    }
    clear() {
      this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
      this.gl.clearColor(0, 0, 0, 0);
      this.gl.clear(this.gl.COLOR_BUFFER_BIT);
    }
    pass(target, width, height, marking) {
      const { gl } = this;
      gl.bindFramebuffer(gl.FRAMEBUFFER, target);
      gl.viewport(0, 0, width, height);
      gl.useProgram(this.program);
      [this.picture, this.matte].forEach((each, unit) => {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, each);
      });
      gl.uniform1i(this.uniform("matte"), 1);
      gl.uniform2f(this.uniform("step_uv"), 1 / this.canvas.width, 1 / this.canvas.height);
      gl.uniform3f(this.uniform("wanted"), +marking.peakReal, +marking.peakVirtual, +marking.zebra);
      gl.uniform1i(this.uniform("measuring"), target ? 1 : 0);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    }
    uniform(name) {
      return this.gl.getUniformLocation(this.program, name);
    }
    upload(target, pixels) {
      this.gl.activeTexture(this.gl.TEXTURE0);
      this.gl.bindTexture(this.gl.TEXTURE_2D, target);
      this.gl.texImage2D(this.gl.TEXTURE_2D, 0, this.gl.RGBA, this.gl.RGBA, this.gl.UNSIGNED_BYTE, pixels);
    }
  };
  function sizeOf(pixels) {
    return pixels instanceof HTMLVideoElement ? [pixels.videoWidth, pixels.videoHeight] : [pixels.width, pixels.height];
  }
  function program(gl) {
    const linked = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(linked, shader);
    }
    gl.linkProgram(linked);
    if (!gl.getProgramParameter(linked, gl.LINK_STATUS)) throw new Error(`the marks do not compile: ${gl.getProgramInfoLog(linked)}`);
    return linked;
  }
  function texture(gl, filter) {
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    return made;
  }
  var HISTOGRAM_EVERY_MS = 200;
  var Histogram = class {
    constructor(canvas) {
      this.canvas = canvas;
    }
    canvas;
    last_ms = 0;
    draw(marks) {
      const now = performance.now();
      if (now - this.last_ms < HISTOGRAM_EVERY_MS) return;
      this.last_ms = now;
      const { width, height } = this.canvas;
      const context = this.canvas.getContext("2d");
      const bins = marks.histogram();
      context.clearRect(0, 0, width, height);
      context.fillStyle = "#e8e6e1";
      const step = width / bins.length;
      bins.forEach((share, i) => context.fillRect(i * step, height * (1 - Math.sqrt(share)), step, height));
    }
  };
  var MATTE_EVERY_MS = 200;
  var MatteFeed = class {
    constructor(take) {
      this.take = take;
    }
    take;
    running = false;
    run(on) {
      if (on && !this.running) void this.loop();
      this.running = on;
    }
    async loop() {
      await Promise.resolve();
      while (this.running) {
        if (model.state?.matte) await this.fetchOne().catch(() => void 0);
        await new Promise((done) => setTimeout(done, MATTE_EVERY_MS));
      }
    }
    async fetchOne() {
      const answer = await fetch("/matte");
      if (!answer.ok) return;
      const bitmap = await createImageBitmap(await answer.blob());
      this.take(bitmap);
      bitmap.close();
    }
  };

  // src/picture.ts
  var THIRDS = [1, 2].flatMap((i) => [`M${i} 0V3`, `M0 ${i}H3`]).join("");
  var PictureView = class extends HTMLElement {
    zoom;
    stage;
    marks = null;
    histogram;
    matte = new MatteFeed((bitmap) => this.marks?.setMatte(bitmap));
    moving = null;
    connectedCallback() {
      this.innerHTML = `<div id="stage">
      <canvas id="picture" role="img" aria-label="camera picture with the virtual object"></canvas>
      <video id="video" muted playsinline autoplay hidden aria-label="camera picture with the virtual object"></video>
      <canvas id="marks"></canvas>
      <svg id="grid" viewBox="0 0 3 3" preserveAspectRatio="none" hidden><path d="${THIRDS}"/></svg>
      <div id="level" hidden></div>
      <output id="spot" hidden></output>
    </div>
    <canvas id="histogram" width="128" height="48" hidden aria-label="histogram"></canvas>
    <span id="tracking" hidden></span>
    <p id="remark" role="status" hidden></p>
    <svg id="arrow" viewBox="-12 -12 24 24" hidden aria-hidden="true"><path d="M-9 -5H1V-10L11 0L1 10V5H-9Z"/></svg>
    <p id="message" role="status">connecting</p>`;
      this.stage = this.find("stage");
      this.zoom = new Zoom(this, this.stage);
      this.marks = Marks.on(this.find("marks"));
      this.histogram = new Histogram(this.find("histogram"));
      showLevel(this.find("level"), () => aids.has("level"));
      listen(this, this.gestures());
      model.addEventListener("frame", () => this.onFrame());
      model.addEventListener("state", () => this.showRemark(model.state?.remark ?? null));
      model.addEventListener("sentence", () => this.find("message").textContent = model.sentence);
      aids.addEventListener("change", () => this.onAids());
      this.onAids();
    }
    find(id) {
      return this.querySelector(`#${id}`);
    }
    gestures() {
      return {
        tap: (x, y) => void this.focusAt(x, y),
        twice: () => this.zoom.reset(),
        dragStart: (x, y) => this.moving = selection.name && model.mayControl ? new ObjectDrag(selection.name, this.inPicture(x, y)) : null,
        drag: (x, y, dx, dy) => this.moving ? this.moving.moveTo(this.inPicture(x, y)) : this.zoom.pan(dx, dy),
        dragEnd: () => this.moving = null,
        pinch: (factor, x, y, dx, dy) => this.zoom.by(factor, x, y, dx, dy)
      };
    }
    /** 0 to 1 right and down, however the picture is zoomed. */
    inPicture(x_px, y_px) {
      const box = this.stage.getBoundingClientRect();
      return [(x_px - box.left) / box.width, (y_px - box.top) / box.height];
    }
    async focusAt(x_px, y_px) {
      const at = this.inPicture(x_px, y_px);
      if (!model.mayControl || at.some((each) => each < 0 || each > 1)) return;
      const spot = this.find("spot");
      [spot.style.left, spot.style.top] = [`${100 * at[0]}%`, `${100 * at[1]}%`];
      spot.textContent = "";
      spot.hidden = false;
      const answer = await control({ focus: { at } });
      if (answer) spot.textContent = distanceText(answer["focus_distance_m"]);
      setTimeout(() => spot.hidden = true, answer ? 2500 : 500);
    }
    onFrame() {
      const { pixels, header } = model.shown;
      const [width, height] = sizeOf(pixels);
      if (width && height) this.style.setProperty("--aspect", `${width / height}`);
      if (this.marks && this.marking) {
        this.marks.draw(pixels, { peakReal: aids.has("peakReal"), peakVirtual: aids.has("peakVirtual"), zebra: aids.has("zebra") });
        if (aids.has("histogram")) this.histogram.draw(this.marks);
      }
      if (!header) return;
      this.showTracking(header.tracking ?? null, header.tracking_unsure === true);
      this.showRemark(header.remark ?? null);
    }
    /** A sentence at the top, and an arrow near the edge where the object went out of the picture. */
    showRemark(remark) {
      const line = this.find("remark");
      const arrow = this.find("arrow");
      line.hidden = remark === null;
      arrow.toggleAttribute("hidden", !remark?.arrow);
      if (remark !== null && line.textContent !== remark.sentence) line.textContent = remark.sentence;
      if (!remark?.arrow) return;
      const [right, down] = remark.arrow;
      line.classList.toggle("low", down < 0);
      const reach = 42 / Math.max(Math.abs(right), Math.abs(down));
      [arrow.style.left, arrow.style.top] = [`${50 + reach * right}%`, `${50 + reach * down}%`];
      arrow.style.transform = `translate(-50%, -50%) rotate(${Math.atan2(down, right)}rad)`;
    }
    get marking() {
      return ["peakReal", "peakVirtual", "zebra", "histogram"].some((aid) => aids.has(aid));
    }
    onAids() {
      this.find("grid").toggleAttribute("hidden", !aids.has("grid"));
      this.find("histogram").hidden = !aids.has("histogram");
      if (!aids.has("level")) this.find("level").hidden = true;
      else void askForLevel();
      if (!this.marks && this.marking) model.say("this browser has no WebGL2, without which nothing can be marked", 6);
      if (!this.marking) this.marks?.clear();
      this.matte.run(aids.has("peakReal") || aids.has("peakVirtual"));
    }
    showTracking(quality, unsure) {
      const badge = this.find("tracking");
      badge.hidden = quality === null;
      if (quality === null) return;
      badge.dataset["quality"] = quality === 0 ? "lost" : unsure ? "unsure" : quality < 0.5 ? "weak" : "good";
      badge.textContent = quality === 0 ? "tracking lost" : unsure ? "tilt unsure: go nearer" : `tracking ${(100 * quality).toFixed(0)} %`;
    }
  };

  // src/transports.ts
  var AGAIN_MS = 1e3;
  function offered(canvas, video, names) {
    const wanted = new URLSearchParams(location.search).get("transport");
    const all = { whep: () => new WhepTransport(video), jpeg: () => new JpegTransport(canvas) };
    const usable = names.filter((name) => (name !== "whep" || "RTCPeerConnection" in window) && (wanted ?? name) === name);
    return usable.flatMap((name) => all[name] ? [all[name]()] : []);
  }
  async function watch(canvas, video) {
    for (; ; ) {
      for (const transport of offered(canvas, video, model.state?.transports ?? [])) {
        counts.restart();
        let shown = false;
        const why = await transport.run(() => {
          shown = true;
          video.hidden = transport.name !== "whep";
          canvas.hidden = !video.hidden;
          model.setWay(transport.name);
          if (!model.state?.failure) model.say("");
        });
        model.say(why);
        if (shown) break;
      }
      do {
        await new Promise((done) => setTimeout(done, AGAIN_MS));
      } while (!await letIn());
    }
  }
  async function letIn() {
    try {
      await refreshState();
      return true;
    } catch (problem) {
      model.say(problem instanceof Error && !(problem instanceof TypeError) ? problem.message : "connection lost, trying again");
      return false;
    }
  }
  var JpegTransport = class {
    constructor(canvas) {
      this.canvas = canvas;
      this.context = canvas.getContext("2d", { alpha: false });
    }
    canvas;
    name = "jpeg";
    context;
    decoder = new TextDecoder();
    run(showing) {
      return new Promise((ended) => {
        const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/stream`);
        socket.binaryType = "arraybuffer";
        let first = true;
        let drawn = Promise.resolve();
        const take = async (data) => {
          const header = await this.draw(data);
          if (first) showing();
          first = false;
          model.show({ pixels: this.canvas, header });
          if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ ack: header.sequence }));
        };
        socket.onopen = () => {
          model.say("waiting for the camera");
          clock.start((text) => socket.readyState === WebSocket.OPEN && socket.send(text));
        };
        socket.onmessage = (event) => {
          if (typeof event.data === "string") this.hear(JSON.parse(event.data), drawn);
          else drawn = take(event.data);
        };
        socket.onclose = () => {
          clock.stop();
          ended("connection lost, trying again");
        };
      });
    }
    hear(message, drawn) {
      const { failure } = message;
      if (message.server_ms !== void 0) clock.answer(message);
      else if (failure !== void 0) void drawn.then(() => model.fail(failure));
      else if (message.error !== void 0) model.say(message.error, 6);
    }
    async draw(data) {
      const length2 = new DataView(data).getUint32(0);
      const header = JSON.parse(this.decoder.decode(new Uint8Array(data, 4, length2)));
      const jpeg = new Blob([new Uint8Array(data, 4 + length2)], { type: "image/jpeg" });
      const bitmap = await createImageBitmap(jpeg).catch(() => null);
      if (bitmap) {
        if (this.canvas.width !== bitmap.width || this.canvas.height !== bitmap.height) {
          this.canvas.width = bitmap.width;
          this.canvas.height = bitmap.height;
        }
        this.context.drawImage(bitmap, 0, 0);
        bitmap.close();
        const now = performance.now();
        counts.count(now);
        counts.know(header, now);
      }
      return header;
    }
  };
  var FIRST_PICTURE_MS = 6e3;
  var STILL_MS = 5e3;
  var MOST_REMEMBERED = 300;
  var WhepTransport = class {
    constructor(video) {
      this.video = video;
    }
    video;
    name = "whep";
    told = /* @__PURE__ */ new Map();
    untold = null;
    lastShown_ms = 0;
    async run(showing) {
      const peer = new RTCPeerConnection({ iceServers: [] });
      let resource = null;
      const leave = () => release(resource);
      window.addEventListener("pagehide", leave);
      try {
        peer.addTransceiver("video", { direction: "recvonly" });
        this.openStatus(peer);
        peer.ontrack = (event) => this.play(event, showing);
        resource = await offerTo("/whep", peer);
        return await this.until(peer);
      } catch (problem) {
        return problem instanceof Error ? problem.message : "video could not be opened";
      } finally {
        window.removeEventListener("pagehide", leave);
        leave();
        clock.stop();
        peer.close();
        this.video.srcObject = null;
      }
    }
    openStatus(peer) {
      const channel = peer.createDataChannel("status");
      channel.onopen = () => clock.start((text) => channel.readyState === "open" && channel.send(text));
      channel.onmessage = (event) => this.hear(JSON.parse(event.data));
    }
    hear(message) {
      if (message.server_ms !== void 0) clock.answer(message);
      else if (message.failure !== void 0) model.fail(message.failure);
      else if (message.error !== void 0) model.say(message.error, 6);
      else if (message.rtp_timestamp !== void 0) this.remember(message);
    }
    remember(header) {
      if (this.untold?.rtp === header.rtp_timestamp) {
        this.know(header, this.untold.shown_ms);
        return;
      }
      this.told.set(header.rtp_timestamp, header);
      if (this.told.size > MOST_REMEMBERED) this.told.delete(this.told.keys().next().value);
    }
    play(event, showing) {
      if ("jitterBufferTarget" in event.receiver) event.receiver.jitterBufferTarget = 0;
      this.video.srcObject = new MediaStream([event.track]);
      void this.video.play().catch(() => void 0);
      const onPicture = (now, metadata) => {
        if (this.lastShown_ms === 0) showing();
        this.lastShown_ms = now;
        this.onPicture(metadata.rtpTimestamp, Math.max(now, metadata.expectedDisplayTime));
        this.video.requestVideoFrameCallback(onPicture);
      };
      this.video.requestVideoFrameCallback(onPicture);
    }
    onPicture(rtp, shown_ms) {
      counts.count(shown_ms);
      const header = rtp === void 0 ? void 0 : this.told.get(rtp);
      if (header) {
        this.told.delete(rtp);
        this.know(header, shown_ms);
      } else {
        this.untold = rtp === void 0 ? null : { rtp, shown_ms };
        model.show({ pixels: this.video, header: null });
      }
    }
    know(header, shown_ms) {
      this.untold = null;
      counts.know(header, shown_ms);
      model.show({ pixels: this.video, header });
    }
    /** Resolves when no picture came in time, none comes any more, or the connection failed. */
    until(peer) {
      const began_ms = performance.now();
      return new Promise((ended) => {
        const end = (why) => {
          clearInterval(watch2);
          ended(why);
        };
        const watch2 = setInterval(() => {
          const now = performance.now();
          if (this.lastShown_ms === 0 && now - began_ms > FIRST_PICTURE_MS) end("no video came, trying pictures");
          if (this.lastShown_ms > 0 && now - this.lastShown_ms > STILL_MS && !model.state?.failure && !document.hidden) end("the video stopped, trying again");
        }, 500);
        peer.onconnectionstatechange = () => {
          if (["failed", "disconnected", "closed"].includes(peer.connectionState)) end("the video connection was lost, trying again");
        };
      });
    }
  };

  // src/main.ts
  var STATE_EVERY_MS = 2e3;
  async function start() {
    await enter();
    await refreshState();
    const picture = document.querySelector("vf-picture");
    void watch(picture.find("picture"), picture.find("video"));
    setInterval(() => void poll(), STATE_EVERY_MS);
    keepAwake();
  }
  async function poll() {
    if (document.hidden) return;
    const before = model.state?.failure ?? null;
    const state = await refreshState().catch(() => null);
    if (state?.failure) model.say(state.failure);
    else if (state && before) model.say("");
  }
  function keepAwake() {
    const ask = () => void navigator.wakeLock?.request("screen").catch(() => void 0);
    ask();
    document.addEventListener("visibilitychange", () => !document.hidden && ask());
  }
  customElements.define("vf-picture", PictureView);
  customElements.define("vf-readout", Readout);
  customElements.define("vf-focus", FocusControl);
  customElements.define("vf-choices", Choices);
  customElements.define("vf-objects", ObjectPicker);
  customElements.define("vf-aids", AidSwitches);
  customElements.define("vf-shutter", Shutter);
  customElements.define("vf-gallery", Gallery);
  Object.assign(window, {
    viewfinder: {
      counts,
      clock,
      model,
      get age() {
        return counts.age_ms;
      },
      get focus() {
        return model.shown?.header?.focus_distance_m;
      }
    }
  });
  start().catch((problem) => model.say(problem instanceof Error ? problem.message : "the viewfinder does not answer"));
})();
