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

  // src/server.ts
  async function enter() {
    const token = new URLSearchParams(location.hash.slice(1)).get("token");
    if (token === null) return;
    history.replaceState(null, "", location.pathname + location.search);
    const answer = await fetch("/enter", posted({ token }));
    if (!answer.ok && (await fetch("/state")).status === 401) throw new Error(await sentenceOf(answer));
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

  // src/studio_model.ts
  var byId = (id) => document.getElementById(id);
  var RESTS_MS = 250;
  var SENTENCE_MS = 8e3;
  var pageName = `p${Math.random().toString(36).slice(2)}`;
  var Studio = class extends EventTarget {
    told = null;
    shown = null;
    sentence = "";
    /** Pictures that reached the screen, and how long the last draft took from the change to the screen. */
    counts = { drafts: 0, whole: 0, draft_ms: 0, whole_ms: 0 };
    pixels = 1e6;
    /** Whether the height of the object was typed in metres, which then stay. */
    metresTyped = false;
    local = {};
    sending = {};
    sends = Promise.resolve();
    changes = 0;
    finished = -1;
    drafting = false;
    warned = false;
    resting;
    quiet;
    /** The state as this page sees it now. */
    get state() {
      return this.told && { ...this.told.state, ...this.sending, ...this.local };
    }
    /** All objects that have a place, in their order. */
    get objects() {
      const state = this.state;
      if (!state) return [];
      const { object, at_px, height, turn_deg } = state;
      return [...state.before, ...object && at_px ? [{ object, at_px, height, turn_deg }] : [], ...state.after];
    }
    get isComplete() {
      const state = this.state;
      return Boolean(this.told?.photo && state?.photo && state.object && state.at_px);
    }
    /** Whether something of this page is not in the server's state yet. */
    get isChanging() {
      return Object.keys(this.local).length + Object.keys(this.sending).length > 0;
    }
    say(sentence, stays = false) {
      this.sentence = sentence;
      clearTimeout(this.quiet);
      if (sentence && !stays) this.quiet = setTimeout(() => this.say(""), SENTENCE_MS);
      this.dispatchEvent(new Event("sentence"));
    }
    /** Change the state on this page; it is drawn at once, and kept by `commit`. */
    change(changes) {
      Object.assign(this.local, changes);
      this.dispatchEvent(new Event("state"));
      this.draw();
    }
    /** The changes by which one of all objects is chosen. */
    choosing(number, objects = this.objects) {
      const chosen = objects[number];
      if (!chosen) return { object: null, at_px: null, height: null, turn_deg: 0, before: [], after: [] };
      return { ...chosen, before: objects.slice(0, number), after: objects.slice(number + 1) };
    }
    /** Take the chosen object away; the one before it is chosen. */
    remove() {
      const number = this.state?.before.length ?? 0;
      const rest = this.objects.filter((_, each) => each !== number);
      if (this.state?.object) void this.commit(this.choosing(Math.max(0, number - 1), rest));
    }
    /** Add an object beside the chosen one. */
    async add(object) {
      await this.commit();
      const told = await this.post("/add", { object });
      if (told) this.take(told);
    }
    /** Keep what was changed: one step of the history. */
    commit(changes = {}) {
      if (Object.keys(changes).length) this.change(changes);
      this.sends = this.sends.then(async () => {
        if (!Object.keys(this.local).length) return;
        this.sending = this.local;
        this.local = {};
        const told = await this.post("/state", { changes: this.sending, metres_typed: this.metresTyped });
        this.sending = {};
        if (told) this.take(told);
        else this.dispatchEvent(new Event("state"));
      });
      return this.sends;
    }
    async step(by) {
      await this.commit();
      const told = await this.post("/history", { step: by });
      if (told) this.take(told);
    }
    /** Take over what the server tells; a state that others changed is drawn. */
    take(told) {
      if (this.told && told.number < this.told.number) return;
      const before = JSON.stringify([this.told?.state, this.told?.photo]);
      this.told = told;
      if (told.problem) this.say(told.problem, true);
      this.dispatchEvent(new Event("told"));
      if (JSON.stringify([told.state, told.photo]) !== before) {
        this.dispatchEvent(new Event("state"));
        this.draw();
      }
    }
    /** Keep asking for news. */
    async follow() {
      for (; ; ) {
        try {
          const answer = await fetch(`/state${this.told ? `?after=${this.told.number}` : ""}`);
          if (!answer.ok) throw new Error(await sentenceOf(answer));
          const told = await answer.json();
          if (this.sentence.startsWith("the studio does not answer")) this.say("");
          if (this.told && told.number < this.told.number) this.told = null;
          this.take(told);
        } catch (problem) {
          const why = problem instanceof TypeError ? "" : ` (${problem.message})`;
          this.say(`the studio does not answer${why}: nothing is lost, this page tries again`, true);
          await new Promise((done) => setTimeout(done, 1e3));
          if (this.told) this.told.number = -1;
        }
      }
    }
    async post(path, message) {
      try {
        const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message) });
        if (answer.ok) return await answer.json();
        this.say(await sentenceOf(answer));
      } catch {
        this.say("the studio does not answer: nothing is lost, try again");
      }
      return null;
    }
    async upload(file) {
      const kind = /\.(glb|gltf)$/i.test(file.name) ? "object" : "photo";
      const most = this.told?.largest[kind] ?? Infinity;
      if (file.size > most) return this.say(`${file.name} is larger than the ${most >> 20} MB that the studio takes: give it on the command line`);
      this.say(`sending ${file.name} ...`, true);
      try {
        const answer = await fetch(`/upload?kind=${kind}&name=${encodeURIComponent(file.name)}`, { method: "POST", body: file });
        if (!answer.ok) return this.say(await sentenceOf(answer));
        const said = this.isComplete ? "the object is added beside the chosen one: drag it to its place" : "click into the photograph where the object is to stand";
        this.say(kind === "object" ? said : "");
        this.take(await answer.json());
      } catch {
        this.say(`${file.name} did not arrive: the studio does not answer`);
      }
    }
    /** Ask for a picture: a draft as soon as the last one is there, the whole one when the hand rests. */
    draw() {
      this.changes++;
      clearTimeout(this.resting);
      if (!this.isComplete) return;
      void this.draft();
      this.resting = setTimeout(() => void this.whole(this.changes), RESTS_MS);
    }
    async draft() {
      if (this.drafting) return;
      this.drafting = true;
      for (let drawn = -1; drawn !== this.changes && this.isComplete; ) {
        drawn = this.changes;
        await this.ask(true, drawn);
      }
      this.drafting = false;
    }
    async whole(change) {
      if (change === this.changes) await this.ask(false, change);
    }
    /** The part of the finished picture, or of the photograph as it is, around a pixel; null where another one was asked for since. */
    async region(x_px, y_px, side_px, before = false) {
      const region = [x_px, y_px, side_px, this.shown?.coc_px[1] ?? 0];
      const message = { changes: { ...this.sending, ...this.local }, pixels: this.pixels, page: before ? `${pageName}b` : pageName, region, before };
      const answer = await fetch("/preview", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message) });
      if (answer.status !== 200) return null;
      const body = await answer.arrayBuffer();
      const length = new DataView(body).getUint32(0);
      return createImageBitmap(new Blob([new Uint8Array(body, 4 + length)], { type: "image/jpeg" }));
    }
    async ask(draft, change) {
      const began = performance.now();
      const message = { changes: { ...this.sending, ...this.local }, draft, pixels: this.pixels, page: pageName };
      try {
        const answer = await fetch("/preview", { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message) });
        if (answer.status === 204) return;
        if (!answer.ok) {
          this.warned = true;
          return this.say(await sentenceOf(answer), true);
        }
        const body = await answer.arrayBuffer();
        const length = new DataView(body).getUint32(0);
        const shown = JSON.parse(new TextDecoder().decode(new Uint8Array(body, 4, length)));
        const bitmap = await createImageBitmap(new Blob([new Uint8Array(body, 4 + length)], { type: "image/jpeg" }));
        if (!draft && change !== this.changes) return;
        if (draft && change <= this.finished) return;
        if (!draft) this.finished = change;
        this.shown = shown;
        if (shown.warnings[0] || this.warned) this.say(shown.warnings[0] ?? "", true);
        this.warned = Boolean(shown.warnings[0]);
        this.counts[draft ? "drafts" : "whole"]++;
        this.counts[draft ? "draft_ms" : "whole_ms"] = Math.round(performance.now() - began);
        this.dispatchEvent(new CustomEvent("picture", { detail: bitmap }));
      } catch {
        this.say("the studio does not answer: nothing is lost, this page tries again", true);
        this.warned = true;
      }
    }
  };
  var studio = new Studio();
  function inPhoto([x, y]) {
    const within = (value, most) => Number(Math.min(most, Math.max(0, value)).toFixed(1));
    return [within(x, studio.told?.photo?.width_px ?? 0), within(y, studio.told?.photo?.height_px ?? 0)];
  }
  function scaledHeight(height, factor, digits = 6) {
    if (height === null) return null;
    const unit = height.endsWith("px") ? "px" : "";
    return `${Number((parseFloat(height) * factor).toPrecision(digits))}${unit}`;
  }

  // src/studio_histogram.ts
  var COLOURS = ["#ff6b6b", "#5ee078", "#6db3ff"];
  var LEVELS = 256;
  var REST_MS = 200;
  var Histogram = class {
    later;
    constructor() {
      studio.addEventListener("picture", () => {
        clearTimeout(this.later);
        this.later = setTimeout(() => this.draw(), REST_MS);
      });
    }
    draw() {
      const picture = byId("picture");
      const canvas = byId("histogram");
      if (!picture.width || !canvas.offsetWidth) return;
      const { data } = picture.getContext("2d").getImageData(0, 0, picture.width, picture.height);
      const counts = COLOURS.map(() => new Uint32Array(LEVELS));
      for (let i = 0; i < data.length; i++) if (i % 4 < 3) counts[i % 4][data[i]]++;
      const pixels = data.length / 4;
      const most = Math.max(1, ...counts.flatMap((each) => [...each.subarray(1, LEVELS - 1)]));
      const context = canvas.getContext("2d");
      context.clearRect(0, 0, canvas.width, canvas.height);
      context.globalCompositeOperation = "lighter";
      counts.forEach((each, channel) => {
        context.fillStyle = COLOURS[channel] + "90";
        for (let level = 0; level < LEVELS; level++) {
          const high = Math.min(1, each[level] / most) * canvas.height;
          context.fillRect(level, canvas.height - high, 1, high);
        }
      });
      const share = (level) => (100 * Math.max(...counts.map((each) => each[level])) / pixels).toFixed(1);
      byId("clipped").textContent = `Black ${share(0)} %, white ${share(LEVELS - 1)} % of the pixels.`;
    }
  };

  // src/studio_ground.ts
  var ACROSS = 5;
  var WIDE = 40;
  var DEEP = 50;
  var LEVELS2 = 4;
  var LEAST_APART = 8e-3;
  var EYES_M = 1.5;
  var BELOW_DEG = 10;
  function lookingDown(pitch_deg, roll_deg) {
    const [cos, sin] = [Math.cos(pitch_deg * Math.PI / 180), Math.sin(pitch_deg * Math.PI / 180)];
    const [level, turned] = [Math.cos(roll_deg * Math.PI / 180), Math.sin(roll_deg * Math.PI / 180)];
    return [[level, -turned, 0], [cos * turned, cos * level, sin], [-sin * turned, -sin * level, cos]];
  }
  var Ground = class {
    constructor(photo, focal_px, state) {
      this.photo = photo;
      this.focal_px = focal_px;
      const isTold = state.pitch_deg !== null || state.roll_deg !== null || !photo.world_from_camera;
      this.turn = isTold ? lookingDown(state.pitch_deg ?? photo.pitch_deg ?? 0, state.roll_deg ?? photo.roll_deg ?? 0) : photo.world_from_camera;
      this.high_m = state.camera_height_m ?? photo.camera_height_m ?? EYES_M;
    }
    photo;
    focal_px;
    turn;
    high_m;
    /** The ray of a pixel, of length 1 along the view, in upright axes. */
    ray([x_px, y_px]) {
      const seen = [(x_px - this.photo.width_px / 2) / this.focal_px, (y_px - this.photo.height_px / 2) / this.focal_px, 1];
      const along = (row) => row[0] * seen[0] + row[1] * seen[1] + row[2] * seen[2];
      return [along(this.turn[0]), along(this.turn[1]), along(this.turn[2])];
    }
    /** Row of the horizon in a column. */
    horizon_px(x_px) {
      const [right2, down, ahead] = this.turn[1];
      const across = (x_px - this.photo.width_px / 2) / this.focal_px;
      return this.photo.height_px / 2 - this.focal_px * (ahead + right2 * across) / down;
    }
    /** Distance along the view of the ground under a pixel, null above the horizon. */
    distance_m(at_px) {
      const falls = this.ray(at_px)[1];
      return falls > 1e-6 ? this.high_m / falls : null;
    }
    /** Length of so many pixels across the view, on the ground under a pixel. */
    length_m(at_px, pixels) {
      return pixels * (this.distance_m(at_px) ?? 0) / this.focal_px;
    }
    /** The pixel, or the nearest below the horizon and within the photograph. */
    within([x, y]) {
      const { width_px, height_px } = this.photo;
      const column = Math.min(width_px - 1, Math.max(0, x));
      const top = Math.max(0, this.horizon_px(column) + 4e-3 * height_px);
      return [column, Math.min(height_px - 1, Math.max(Math.min(top, height_px - 1), y))];
    }
    /** Middle of the lowest row. */
    get lowest_px() {
      return [this.photo.width_px / 2, this.photo.height_px];
    }
    /** Distance ahead on the ground, level, of what the lowest row shows; null where it shows no ground. */
    get nearest_m() {
      const z_m = this.distance_m(this.lowest_px);
      return z_m === null ? null : z_m * this.ray(this.lowest_px)[2];
    }
    /** Whether the picture shows ground at all. */
    get isInSight() {
      return this.distance_m(this.lowest_px) !== null && this.horizon_px(this.photo.width_px / 2) < 0.97 * this.photo.height_px;
    }
    /** How far a camera looks down, in degrees, for which the ground at a pixel lies as deep below the horizon as it usually does. */
    usualTilt_deg([, y_px]) {
      const below_deg = Math.atan((y_px - this.photo.height_px / 2) / this.focal_px) * 180 / Math.PI;
      return Number(Math.max(0, BELOW_DEG - below_deg).toFixed(1));
    }
    /** Side of a cell of the grid, metres: 1, 2 or 5 of a power of ten, about five of which fit into the lowest row. */
    get cell_m() {
      const z_m = this.distance_m(this.lowest_px) ?? this.high_m;
      const wanted = z_m * this.photo.width_px / this.focal_px / ACROSS;
      const power = 10 ** Math.floor(Math.log10(wanted));
      return Number((power * (wanted / power >= 5 ? 5 : wanted / power >= 2 ? 2 : 1)).toPrecision(1));
    }
    /** The grid as the path of an SVG in pixels of the photograph. */
    grid() {
      const [cell, nearest_m] = [this.cell_m, this.nearest_m];
      if (nearest_m === null) return "";
      const lines = [];
      const cut_m = 0.02 * this.high_m;
      let [first, row_px] = [Math.floor(nearest_m / cell) - 1, Infinity];
      for (let side = cell, level = 0; level < LEVELS2; side *= 5, level++) {
        let last = first;
        for (; last <= first + DEEP; last++) {
          const [, y, z] = this.seen(0, last * side);
          if (z > cut_m && row_px - y < LEAST_APART * this.photo.height_px) break;
          row_px = z > cut_m ? y : row_px;
          this.line(lines, [-WIDE * side, last * side], [WIDE * side, last * side], cut_m);
        }
        for (let i = -WIDE; i <= WIDE; i++) this.line(lines, [i * side, first * side], [i * side, last * side], cut_m);
        first = Math.ceil(last / 5);
      }
      return lines.join("");
    }
    /** A circle on the ground about a pixel, as the path of an SVG. */
    circle(at_px, radius_m) {
      const z_m = this.distance_m(at_px);
      if (z_m === null) return "";
      const [x, , ahead] = this.ray(at_px);
      const points = Array.from({ length: 33 }, (_, i) => {
        const turn = i / 32 * 2 * Math.PI;
        return this.seen(x * z_m + radius_m * Math.cos(turn), ahead * z_m + radius_m * Math.sin(turn));
      });
      if (points.some((each) => each[2] <= 0)) return "";
      return points.map(([across, down], i) => `${i ? "L" : "M"}${across.toFixed(1)} ${down.toFixed(1)}`).join("");
    }
    /** Pixel and depth of a point of the ground. */
    seen(x_m, ahead_m) {
      const z = this.depth(x_m, ahead_m);
      const column = (i) => this.turn[0][i] * x_m + this.turn[1][i] * this.high_m + this.turn[2][i] * ahead_m;
      return [this.photo.width_px / 2 + this.focal_px * column(0) / z, this.photo.height_px / 2 + this.focal_px * column(1) / z, z];
    }
    depth(x_m, ahead_m) {
      return this.turn[0][2] * x_m + this.turn[1][2] * this.high_m + this.turn[2][2] * ahead_m;
    }
    line(lines, [x0, a0], [x1, a1], nearest_m) {
      const [z0, z1] = [this.depth(x0, a0), this.depth(x1, a1)];
      if (z0 < nearest_m && z1 < nearest_m) return;
      const cut = (x, a, z, x2, a2, z2) => {
        if (z >= nearest_m) return [x, a];
        const share = (nearest_m - z) / (z2 - z);
        return [x + share * (x2 - x), a + share * (a2 - a)];
      };
      const [p, q] = [this.seen(...cut(x0, a0, z0, x1, a1, z1)), this.seen(...cut(x1, a1, z1, x0, a0, z0))];
      lines.push(`M${p[0].toFixed(1)} ${p[1].toFixed(1)}L${q[0].toFixed(1)} ${q[1].toFixed(1)}`);
    }
  };
  function groundOf(photo, state) {
    return photo && state && photo.focal_px !== null && !photo.has_depth && !state.plain ? new Ground(photo, photo.focal_px, state) : null;
  }

  // src/studio_panel.ts
  var F_NUMBERS = [1, 1.2, 1.4, 1.8, 2, 2.2, 2.4, 2.8, 3.2, 3.5, 4, 4.5, 5, 5.6, 6.3, 7.1, 8, 9, 10, 11, 13, 14, 16, 18, 20, 22, 25, 29, 32];
  var LONG_FORMATS = { png: "PNG, 16 bit", jpeg: "JPEG", tiff: "TIFF, 16 bit", exr: "EXR, layers", clip: "Clip, MP4" };
  var DEFAULT_SUN = [-125, 50];
  var DAYLIGHT_MIRED = 1e6 / 6504;
  var nearestF = (f_number) => {
    const apart = F_NUMBERS.map((each) => Math.abs(Math.log(each / f_number)));
    return apart.indexOf(Math.min(...apart));
  };
  var degrees = (value) => `${value}°`;
  var SLIDERS = [
    { id: "turn", read: (s) => s.turn_deg, write: (turn_deg) => ({ turn_deg }), shown: (v) => degrees(Math.round(v)) },
    {
      id: "f_number",
      read: (s) => nearestF(s.f_number ?? studio.told?.photo?.lens_f_number ?? 8),
      write: (value) => ({ f_number: Math.max(F_NUMBERS[Math.min(value, F_NUMBERS.length - 1)], studio.told?.photo?.widest_f_number ?? 0) }),
      shown: (_v, s) => `f/${Number((s.f_number ?? studio.told?.photo?.lens_f_number ?? 8).toPrecision(3))}`
    },
    { id: "sun_right", read: (s) => sunOf(s)[0], write: (v) => sun([v, above()]), shown: (v, s) => s.sun_deg ? `${Math.abs(Math.round(v))}° ${v < 0 ? "left" : "right"}` : "" },
    { id: "sun_above", read: (s) => sunOf(s)[1], write: (v) => sun([right(), v]), shown: (v, s) => s.sun_deg ? degrees(Math.round(v)) : "" },
    {
      id: "exposure",
      read: (s) => Math.log2(Math.max(s.exposure, 1e-3)),
      write: (v) => ({ exposure: Number((2 ** v).toPrecision(4)) }),
      shown: (v) => `${v > 0 ? "+" : ""}${v.toFixed(1)} stops`
    },
    {
      id: "warmth",
      read: (s) => s.warmth_k ? Math.round(DAYLIGHT_MIRED - 1e6 / s.warmth_k) : 0,
      write: (v) => ({ warmth_k: v === 0 ? null : Math.round(1e6 / (DAYLIGHT_MIRED - v)) }),
      shown: (v) => v === 0 ? "as guessed" : `${v > 0 ? "warmer" : "cooler"} by ${Math.abs(v)}`
    },
    { id: "shadow", read: (s) => s.shadow ?? 1, write: (v) => ({ shadow: v === 1 ? null : v }), shown: (v) => `${Math.round(100 * v)} %` },
    { id: "pitch", read: (s) => s.pitch_deg ?? studio.told?.photo?.pitch_deg ?? 0, write: (pitch_deg) => keepingSizes({ pitch_deg }), shown: (v) => degrees(v) },
    { id: "roll", read: (s) => s.roll_deg ?? studio.told?.photo?.roll_deg ?? 0, write: (roll_deg) => keepingSizes({ roll_deg }), shown: (v) => degrees(v) }
  ];
  var sunOf = (state) => state?.sun_deg ?? studio.told?.photo?.sun_deg ?? DEFAULT_SUN;
  var right = () => sunOf(studio.state)[0];
  var above = () => sunOf(studio.state)[1];
  var sun = (sun_deg) => ({ sun_deg, plain: false });
  var NUMBERS = [
    { id: "focus", name: "focus_m", also: { focus_at_px: null } },
    { id: "camera_height", name: "camera_height_m", also: { measured: null } },
    { id: "focal_length", name: "focal_length_mm" },
    { id: "sensor_width", name: "sensor_width_mm" }
  ];
  var Panel = class {
    constructor() {
      for (const each of SLIDERS) this.slider(each);
      for (const each of NUMBERS) this.number(each.id, each.name, each.also ?? {});
      this.height();
      this.slices();
      this.switches();
      this.dome();
      this.result();
      this.files();
      this.saveAtOnce();
      const react = (id, changes) => byId(id).addEventListener("click", () => void studio.commit(changes()));
      react("focus_auto", () => ({ focus_m: null, focus_at_px: null }));
      react("f_number_auto", () => ({ f_number: null }));
      react("camera_found", () => ({ camera: studio.told?.camera?.file ?? null, pitch_deg: null, roll_deg: null }));
      byId("object").addEventListener("change", (event) => {
        const object = event.target.value;
        if (object) void studio.commit({ object, height: null });
        else studio.remove();
      });
      byId("chosen").addEventListener("change", (event) => void studio.commit(studio.choosing(Number(event.target.value))));
      byId("add").addEventListener("change", (event) => {
        const select = event.target;
        if (select.value) void studio.add(select.value);
        select.value = "";
      });
      byId("remove").addEventListener("click", () => studio.remove());
      for (const [id, by] of [["undo", -1], ["redo", 1]]) byId(id).addEventListener("click", () => void studio.step(by));
      studio.addEventListener("told", () => this.told());
      studio.addEventListener("state", () => this.state());
      studio.addEventListener("picture", () => this.shown());
      studio.addEventListener("sentence", () => byId("message").textContent = studio.sentence);
    }
    slider(each) {
      const input = byId(each.id);
      let before = null;
      input.addEventListener("pointerdown", () => before = studio.state ? each.read(studio.state) : null);
      input.addEventListener("pointercancel", () => before !== null && void studio.commit(each.write(before)));
      if (each.id === "f_number") input.max = String(F_NUMBERS.length - 1);
      input.addEventListener("input", () => studio.change(each.write(input.valueAsNumber)));
      input.addEventListener("change", () => void studio.commit(each.write(input.valueAsNumber)));
    }
    number(id, name, also) {
      const input = byId(id);
      input.addEventListener("change", () => {
        const value = input.value === "" ? null : input.valueAsNumber;
        if (value !== null && !(value > 0)) return studio.say("give a number above 0, or nothing for automatic");
        const changes = { [name]: value, ...also };
        void studio.commit(id === "camera_height" ? keepingSizes(changes) : changes);
      });
    }
    height() {
      const input = byId("height");
      input.addEventListener("change", () => {
        studio.metresTyped = !input.value.trim().endsWith("px");
        void studio.commit({ height: input.value.trim().replace(",", ".") || null });
      });
    }
    /** Another picture of the stack is opened once the hand lets the handle go. */
    slices() {
      const input = byId("slice");
      input.addEventListener("input", () => this.sliceTold(input.valueAsNumber));
      input.addEventListener("change", () => void studio.commit({ slice: input.valueAsNumber }));
    }
    sliceTold(slice) {
      const photo = studio.told?.photo;
      const metres = photo?.focus_distances_m?.[slice];
      const told = `slice ${slice} of 0 to ${(photo?.slices ?? 1) - 1}${metres ? `, focused at ${Number(metres.toPrecision(3))} m` : ""}`;
      byId("slice_row").querySelector("output").textContent = told;
      byId("slice").setAttribute("aria-valuetext", told);
    }
    switches() {
      const auto = byId("sun_auto");
      auto.addEventListener("change", () => void studio.commit(auto.checked ? { sun_deg: null } : sun([right(), above()])));
      const matched = byId("matched");
      matched.addEventListener("change", () => void studio.commit({ matched: matched.checked }));
      const plain = byId("plain");
      plain.addEventListener("change", () => void studio.commit(plain.checked ? { plain: true, sun_deg: null } : { plain: false }));
    }
    /** The handle on the dome: the middle is overhead, the rim the horizon, up is ahead. */
    dome() {
      const dome = byId("dome");
      const moved = (event) => {
        const box = dome.getBoundingClientRect();
        const [x, y] = [(event.clientX - box.left) / box.width * 220 - 110, (event.clientY - box.top) / box.height * 220 - 110];
        const high = Math.max(2, Math.round(90 - 0.9 * Math.min(100, Math.hypot(x, y))));
        studio.change(sun([Math.round(Math.atan2(x, -y) * 180 / Math.PI), high]));
      };
      dome.addEventListener("pointerdown", (event) => {
        dome.setPointerCapture(event.pointerId);
        moved(event);
      });
      dome.addEventListener("pointermove", (event) => event.buttons && moved(event));
      dome.addEventListener("pointerup", () => void studio.commit());
    }
    result() {
      byId("copy").addEventListener("click", () => {
        const text = byId("command").textContent ?? "";
        const done = () => studio.say("the command is copied");
        navigator.clipboard?.writeText(text).then(done, () => studio.say("the browser does not let this page copy: select the command by hand"));
        if (!navigator.clipboard) getSelection()?.selectAllChildren(byId("command"));
      });
    }
    /** The header's button saves in the format that was saved last, and shows where the picture goes. */
    saveAtOnce() {
      byId("to_save").addEventListener("click", () => {
        if (!studio.isComplete) return studio.say("place an object first: then its picture can be saved");
        if (studio.told.saves.length) return void save(studio.told.format);
        studio.say("choose a format under Save: the next time this button takes the same");
        byId("formats").querySelector("button")?.focus();
      });
    }
    files() {
      for (const id of ["open_photo", "open_object"]) {
        const input = byId(id);
        input.addEventListener("change", () => {
          for (const file of input.files ?? []) void studio.upload(file);
          input.value = "";
        });
      }
      const drop = byId("drop");
      addEventListener("dragover", (event) => {
        event.preventDefault();
        drop.hidden = false;
      });
      addEventListener("dragleave", (event) => event.relatedTarget === null && (drop.hidden = true));
      addEventListener("drop", async (event) => {
        event.preventDefault();
        drop.hidden = true;
        for (const file of event.dataTransfer?.files ?? []) await studio.upload(file);
      });
    }
    /** What the server tells beside the state. */
    told() {
      const told = studio.told;
      byId("undo").disabled = !told.can_undo;
      byId("redo").disabled = !told.can_redo;
      byId("camera_told").textContent = told.photo?.has_depth && !told.state.lines.length ? "The photograph has depth: the ground slopes as that says." : told.camera?.told ?? (told.photo ? "The camera is looked for in the picture's lines." : "");
      byId("camera_found").disabled = told.camera?.file === void 0;
      byId("plain").disabled = Boolean(told.photo && !told.photo.has_depth && !told.state.plain);
      const photo = told.photo;
      document.querySelectorAll(".of_still").forEach((each) => each.hidden = told.clip !== null);
      byId("slice_row").hidden = photo?.slices === void 0;
      document.querySelectorAll(".of_one").forEach((each) => each.hidden = photo?.slices !== void 0);
      if (photo?.slices !== void 0) {
        const input = byId("slice");
        input.max = String(photo.slices - 1);
        input.value = String(told.state.slice ?? 0);
        this.sliceTold(input.valueAsNumber);
      }
      byId("kept").textContent = `Everything is kept in ${told.project}`;
      this.choices();
      this.saves(told.saves);
      this.state();
    }
    choices() {
      const told = studio.told;
      offer("object", [["", "choose one"], ...told.objects.map((each) => [each.path, each.name])]);
      offer("add", [["", "choose one"], ...told.objects.map((each) => [each.path, each.name])]);
      const lenses = byId("lenses");
      if (lenses.dataset.shown !== JSON.stringify(told.lenses)) {
        lenses.dataset.shown = JSON.stringify(told.lenses);
        lenses.querySelectorAll("label").forEach((each) => each.remove());
        lenses.append(lensChoice("", "as the photograph tells", null), ...told.lenses.map((each, i) => lensChoice(each.path, each.name, i)));
      }
      const formats = byId("formats");
      if (formats.dataset.shown !== String(told.formats)) {
        formats.dataset.shown = String(told.formats);
        formats.replaceChildren();
        for (const format of told.formats) {
          const button = document.createElement("button");
          button.textContent = LONG_FORMATS[format] ?? format;
          button.dataset.format = format;
          button.addEventListener("click", () => void save(format));
          formats.append(button);
        }
      }
    }
    saves(saves) {
      byId("saves").replaceChildren(...saves.map(saveLine));
    }
    state() {
      const state = studio.state;
      if (!state) return;
      for (const each of SLIDERS) {
        const input = byId(each.id);
        const value = each.read(state);
        if (document.activeElement !== input || input.valueAsNumber !== value) input.value = String(value);
        const output = input.closest("label").querySelector("output");
        output.textContent = each.shown(value, state);
        input.setAttribute("aria-valuetext", output.textContent);
      }
      for (const { id, name } of NUMBERS) this.fill(id, state[name] === null ? "" : String(state[name]));
      this.fill("height", scaledHeight(state.height, 1, 3) ?? "");
      byId("object").value = state.object ?? "";
      const objects = studio.objects;
      offer("chosen", objects.map((each, number) => [String(number), `${number + 1}: ${nameOf(each.object)}`]));
      byId("chosen").value = String(state.before.length);
      byId("chosen_row").hidden = objects.length < 2;
      byId("add_row").hidden = !objects.length;
      byId("sun_auto").checked = state.sun_deg === null;
      byId("matched").checked = state.matched;
      byId("plain").checked = state.plain;
      document.querySelectorAll("input[name=lens]").forEach((each) => each.checked = each.value === (state.lens ?? ""));
      const [turn, high] = sunOf(state);
      const byFile = studio.told?.photo?.sun_deg;
      byId("sun_told").textContent = byFile ? `By place, time and compass in the file the sun stood ${Math.abs(byFile[0])}° to the ${byFile[0] < 0 ? "left" : "right"} and ${byFile[1]}° high, if it shone.` : "";
      byId("height_note").textContent = heightNote(state);
      const reach = (90 - high) / 0.9;
      const lamp = byId("lamp");
      lamp.setAttribute("cx", String(reach * Math.sin(turn * Math.PI / 180)));
      lamp.setAttribute("cy", String(-reach * Math.cos(turn * Math.PI / 180)));
      byId("dome").classList.toggle("off", state.sun_deg === null);
      byId("command").textContent = this.commands((studio.isChanging ? studio.shown?.command : studio.told?.command) ?? null);
      document.querySelectorAll("#formats button").forEach((each) => each.disabled = !studio.isComplete);
      byId("focus_told").textContent = focusTold(state);
    }
    /** The command of the picture, and before it that of the whole clip. */
    commands(picture) {
      const clip = studio.told?.clip && !studio.isChanging ? studio.told.clip.command : null;
      return [...clip ? [clip] : [], picture ?? "Place an object first."].join("\n\n");
    }
    fill(id, text) {
      const input = byId(id);
      if (document.activeElement !== input) input.value = text;
    }
    shown() {
      const shown = studio.shown;
      byId("guessed").replaceChildren(
        ...[...groundTold(), ...shown.guessed, ...shown.warnings].map((sentence) => Object.assign(document.createElement("li"), { textContent: sentence }))
      );
      if (studio.isChanging) byId("command").textContent = this.commands(shown.command);
      if (studio.state) byId("focus_told").textContent = focusTold(studio.state);
    }
  };
  function keepingSizes(changes) {
    const [photo, state] = [studio.told?.photo ?? null, studio.state];
    const [from, to] = [groundOf(photo, state), state && groundOf(photo, { ...state, ...changes })];
    if (!state || !from || !to || studio.metresTyped) return changes;
    const scaled = ({ at_px, height }) => {
      const factor = (to.distance_m(at_px) ?? 0) / (from.distance_m(at_px) ?? 0);
      return height?.endsWith("px") || !Number.isFinite(factor) || !factor ? height : scaledHeight(height, factor);
    };
    const all = (placed) => placed.map((each) => ({ ...each, height: scaled(each) }));
    return { ...changes, height: state.at_px && scaled({ at_px: state.at_px, height: state.height }), before: all(state.before), after: all(state.after) };
  }
  function heightNote(state) {
    const by = studio.told?.clip ? ", by the track" : state.measured ? ", by the known height" : " (see below)";
    const guessed = state.camera_height_m && !studio.told?.photo?.has_depth ? ` for a camera ${state.camera_height_m} m above the ground${by}` : "";
    return `Metres${guessed}, or pixels such as 120px. Wheel, pinch, + and - scale it.`;
  }
  function groundTold() {
    const [told, state] = [studio.told, studio.state];
    if (!told?.photo || told.photo.has_depth || !state?.camera_height_m) return [];
    const tilt = state.camera === null && state.pitch_deg !== null ? [`The camera looks down by ${state.pitch_deg}°, which little in the picture tells: see Camera and ground, or draw Lines.`] : [];
    if (state.measured) return tilt;
    return [...tilt, `The camera is ${state.camera_height_m} m above the ground, or the table that it stands on; all metres hang on that.`];
  }
  async function save(format) {
    await studio.commit();
    const answer = await studio.post("/save", { format });
    if (answer) studio.take(answer);
  }
  var nameOf = (path) => path.replace(/^.*[\\/]/, "").replace(/\.\w+$/, "");
  function offer(id, choices) {
    const select = byId(id);
    if (select.dataset.shown === JSON.stringify(choices)) return;
    select.dataset.shown = JSON.stringify(choices);
    select.replaceChildren(...choices.map(([value, name]) => new Option(name, value)));
  }
  function focusTold(state) {
    const shown = studio.shown;
    if (!shown || !studio.isComplete) return "Click Focus here, then what is to be in focus.";
    const from = state.focus_m !== null || state.focus_at_px !== null ? "as chosen" : studio.told?.photo?.focus_m ? "as the photograph states" : studio.told?.photo?.slices ? "as the stack tells" : "on the object";
    if (studio.told?.photo?.focus_distances_m?.length === 0) return `The stack does not know its metres; the object is blurred${blurTold(shown.coc_px)}.`;
    const at = shown.focus_m === null ? "infinity" : `${Number(shown.focus_m.toPrecision(3))} m`;
    return `Focused at ${at}, ${from}; the object is blurred${blurTold(shown.coc_px)}.`;
  }
  var blurTold = ([least, most]) => least === void 0 || most === void 0 ? " by its distance" : ` by ${least.toFixed(1)} to ${most.toFixed(1)} px of the photograph`;
  function lensChoice(path, name, number) {
    const label = document.createElement("label");
    const input = Object.assign(document.createElement("input"), { type: "radio", name: "lens", value: path });
    input.addEventListener("change", () => void studio.commit({ lens: path || null }));
    label.append(input);
    if (number !== null) label.append(Object.assign(document.createElement("img"), { src: `/lens/${number}`, alt: "shape of its bokeh" }));
    label.append(name);
    return label;
  }
  function saveLine(save2) {
    const line = document.createElement("li");
    if (save2.state === "running") {
      const cancel = Object.assign(document.createElement("button"), { textContent: `Cancel ${save2.name}` });
      cancel.addEventListener("click", () => void studio.post("/cancel", { number: save2.number }));
      const bar = document.createElement("progress");
      bar.setAttribute("aria-label", `making ${save2.name}`);
      line.append(`making ${save2.name} ... `, bar, cancel);
    } else if (save2.state === "done") {
      const link = Object.assign(document.createElement("a"), { href: `/saved/${save2.number}`, textContent: `Download ${save2.name}` });
      link.setAttribute("download", save2.name);
      line.append(link, ` (${save2.seconds} s) ${save2.path}`);
    } else {
      line.append(`${save2.name}: ${save2.state === "failed" ? save2.sentence : "cancelled"}`);
    }
    return line;
  }

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

  // src/studio_brush.ts
  var MOST_POINTS = 2e3;
  var Brush = class {
    size = byId("brush_size");
    drawn = byId("stroke");
    tint = byId("matte");
    points = [];
    waiting = 0;
    constructor() {
      const button = byId("brush");
      button.addEventListener("click", () => {
        button.setAttribute("aria-pressed", String(!this.on));
        byId("brush_behind").setAttribute("aria-pressed", "false");
        studio.say(this.on ? "paint over what is in front of the object: the edge snaps to the picture's" : "", this.on);
        this.show();
      });
      const behind = byId("brush_behind");
      behind.addEventListener("click", () => behind.setAttribute("aria-pressed", String(behind.getAttribute("aria-pressed") !== "true")));
      const hide = byId("brush_hide");
      const hidden = (on) => {
        hide.setAttribute("aria-pressed", String(on));
        byId("before").hidden = !on;
        studio.dispatchEvent(new Event("before"));
      };
      hide.addEventListener("click", () => hidden(hide.getAttribute("aria-pressed") !== "true"));
      button.addEventListener("click", () => hidden(false));
      byId("brush_clear").addEventListener("click", () => void studio.commit({ matte: null }));
      const stage = byId("stage");
      stage.addEventListener("pointerleave", () => this.points.length || this.drawn.replaceChildren());
      studio.addEventListener("state", () => this.show());
    }
    get on() {
      return byId("brush").getAttribute("aria-pressed") === "true";
    }
    get radius_px() {
      return this.size.valueAsNumber / 1e3 * (studio.told?.photo?.width_px ?? 1e3);
    }
    /** Show the brush's settings, and what it has told so far. */
    show() {
      const matte = studio.state?.matte ?? null;
      byId("stage").classList.toggle("painting", this.on);
      byId("brush_row").hidden = !this.on;
      byId("brush_clear").disabled = !matte;
      this.tint.hidden = !this.on || !matte;
      if (!this.on) this.drop();
      const source = `/matte?of=${encodeURIComponent(matte ?? "")}`;
      if (matte && this.on && this.tint.getAttribute("src") !== source) this.tint.src = source;
    }
    /** A wheel or two fingers change the brush's size. */
    scale(factor) {
      this.size.valueAsNumber *= factor;
    }
    start(at_px) {
      this.points = [at_px];
      this.draw();
    }
    move(at_px) {
      const last = this.points.at(-1);
      if (!last || Math.hypot(at_px[0] - last[0], at_px[1] - last[1]) < this.radius_px / 6 || this.points.length >= MOST_POINTS) return;
      this.points.push(at_px);
      this.draw();
    }
    /** The ring of the brush under a pointer that only hovers. */
    hover(at_px) {
      if (this.points.length || this.waiting) return;
      this.points = [at_px];
      this.draw();
      this.points = [];
    }
    /** Forget a stroke that became a pinch. */
    drop() {
      this.points = [];
      this.drawn.replaceChildren();
    }
    async end() {
      const points = this.points.map(inPhoto);
      const front = byId("brush_behind").getAttribute("aria-pressed") !== "true";
      this.points = [];
      this.waiting++;
      await studio.commit();
      studio.say("finding the edge ...", true);
      const told = await studio.post("/paint", { points, radius: Math.max(1, this.radius_px), front });
      if (told) studio.take(told);
      if (--this.waiting) return;
      this.drawn.replaceChildren();
      if (told) studio.say("");
    }
    draw() {
      const photo = studio.told?.photo;
      if (!photo) return;
      this.drawn.setAttribute("viewBox", `0 0 ${photo.width_px} ${photo.height_px}`);
      const line = document.createElementNS(this.drawn.namespaceURI, "path");
      const data = this.points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");
      line.setAttribute("d", this.points.length > 1 ? data : `${data}l0.01 0`);
      line.setAttribute("stroke-width", String(2 * this.radius_px));
      this.drawn.replaceChildren(line);
    }
  };

  // src/studio_lines.ts
  var AXES = ["y", "x", "z", "h", "m"];
  var isOnly = (axis) => axis === "h" || axis === "m";
  var NEAR = 16;
  var ON_IT = 10;
  var SHORTEST = 12;
  var Lines = class {
    drawn = byId("lines");
    metres = byId("metres");
    axis = "y";
    lines = null;
    /** The end that is dragged: line, and 0 or 2 for its first coordinate. */
    end = [0, 2];
    constructor() {
      const button = byId("draw_lines");
      button.addEventListener("click", () => {
        button.setAttribute("aria-pressed", String(!this.on));
        studio.say(this.on ? "draw along the horizon where it is seen, or along edges: two of one direction, such as Upright, and one of another; drag an end to move it, tap the middle of a line to remove it" : "", this.on);
        this.draw();
      });
      for (const axis of AXES) {
        byId(`axis_${axis}`).addEventListener("click", () => {
          this.axis = axis;
          for (const each of AXES) byId(`axis_${each}`).setAttribute("aria-pressed", String(each === axis));
          if (axis === "m") studio.say("draw from the foot to the head of somebody, or of something upright, and type how high that is", true);
          this.draw();
          if (axis === "m") byId("metres_row").scrollIntoView({ block: "nearest", inline: "nearest" });
        });
      }
      byId("lines_clear").addEventListener("click", () => void studio.commit({ lines: [], measured: null }));
      this.metres.addEventListener("change", () => this.keep(this.known));
      for (const event of ["state", "view"]) studio.addEventListener(event, () => this.draw());
      studio.addEventListener("told", () => this.on && this.known.length && studio.say(this.said(), true));
    }
    /** All lines of the state. */
    get known() {
      const [lines, measured] = [studio.state?.lines ?? [], studio.state?.measured];
      return [...lines.map((each) => [...each]), ...measured ? [[...measured.slice(0, 4), "m"]] : []];
    }
    /** What the lines tell. */
    said() {
      const { lines, measured, camera_height_m } = studio.state;
      const scale = measured && camera_height_m ? [`By the known height the camera stands ${Number(camera_height_m.toPrecision(3))} m above the ground.`] : [];
      return [...lines.length ? [studio.told?.camera?.told ?? ""] : [], ...scale].join(" ");
    }
    /** Keep lines, of which one may be of known height. */
    keep(lines) {
      const metres = this.metres.valueAsNumber;
      const known = lines.find((each) => each[4] === "m");
      if (known && !(metres > 0)) return studio.say("give how many metres high it is, above 0");
      const changes = { lines: lines.filter((each) => each[4] !== "m"), measured: known ? [...known.slice(0, 4), metres] : null };
      const same = (name) => JSON.stringify(changes[name]) === JSON.stringify(studio.state?.[name]);
      for (const name of ["lines", "measured"]) if (same(name)) delete changes[name];
      if (Object.keys(changes).length) void studio.commit(changes);
      else this.draw();
    }
    get on() {
      return byId("draw_lines").getAttribute("aria-pressed") === "true";
    }
    /** Take the near end of a line, or begin a new one. px: pixels of the photograph in one of the window. */
    start(at_px, px) {
      this.lines = this.known;
      const reach = (axis) => (axis === this.axis ? NEAR : ON_IT) * px;
      const ends = this.lines.flatMap((each, line) => [0, 2].map((i) => ({ line, i, away: Math.hypot(each[i] - at_px[0], each[i + 1] - at_px[1]) / reach(each[4]) })));
      const nearest = ends.sort((one, other) => one.away - other.away)[0];
      if (nearest && nearest.away < 1) this.end = [nearest.line, nearest.i];
      else this.end = [(this.lines = this.lines.filter((each) => each[4] !== this.axis || !isOnly(this.axis))).push([at_px[0], at_px[1], at_px[0], at_px[1], this.axis]) - 1, 2];
    }
    move(at_px) {
      const line = this.lines?.[this.end[0]];
      if (!line) return;
      [line[this.end[1]], line[this.end[1] + 1]] = inPhoto(at_px);
      this.draw();
    }
    /** pinched: the line became a pinch, and is forgotten. */
    stop(px, pinched) {
      const lines = pinched ? void 0 : this.lines?.filter((each) => Math.hypot(each[2] - each[0], each[3] - each[1]) > SHORTEST * px);
      this.lines = null;
      if (pinched) this.draw();
      if (lines) this.keep(lines);
    }
    /** Remove the line under a finger. */
    tap([x, y], px) {
      const lines = this.known;
      const away = ([x1, y1, x2, y2]) => {
        const along = Math.min(1, Math.max(0, ((x - x1) * (x2 - x1) + (y - y1) * (y2 - y1)) / Math.hypot(x2 - x1, y2 - y1) ** 2));
        return Math.hypot(x1 + along * (x2 - x1) - x, y1 + along * (y2 - y1) - y);
      };
      const nearest = [...lines].sort((one, other) => away(one) - away(other))[0];
      const isAtEnd = nearest && Math.min(Math.hypot(x - nearest[0], y - nearest[1]), Math.hypot(x - nearest[2], y - nearest[3])) < NEAR * px;
      if (nearest && !isAtEnd && away(nearest) < NEAR * px) this.keep(lines.filter((each) => each !== nearest));
    }
    draw() {
      const photo = studio.told?.photo;
      const lines = this.lines ?? this.known;
      byId("lines_row").hidden = !this.on;
      byId("metres_row").hidden = this.axis !== "m";
      if (studio.state?.measured && document.activeElement !== this.metres) this.metres.value = String(studio.state.measured[4]);
      byId("lines_clear").disabled = !lines.length;
      this.drawn.replaceChildren();
      if (!photo || !this.on) return;
      this.drawn.setAttribute("viewBox", `0 0 ${photo.width_px} ${photo.height_px}`);
      const size = photo.width_px / this.drawn.clientWidth;
      for (const [x1, y1, x2, y2, axis] of lines) this.drawn.append(drawnLine(this.drawn, [[x1, y1], [x2, y2]], axis, size));
    }
  };
  function drawnLine(drawing, points, kind, size) {
    const line = document.createElementNS(drawing.namespaceURI, "path");
    const ring = ([x, y]) => `M${x - 5 * size} ${y}a${5 * size} ${5 * size} 0 1 0 ${10 * size} 0a${5 * size} ${5 * size} 0 1 0 ${-10 * size} 0`;
    line.setAttribute("d", points.map(([x, y], i) => `${i ? "L" : "M"}${x} ${y}`).join("") + points.map(ring).join(""));
    line.setAttribute("class", kind);
    line.setAttribute("vector-effect", "non-scaling-stroke");
    return line;
  }
  var POINTS = ["click the top of something that stands upright in the sun", "now its foot, on the ground below that top", "now the tip of its shadow on the ground"];
  var Shadow = class {
    button = byId("sun_by");
    drawn = byId("pointed");
    points = [];
    photo = "";
    constructor() {
      studio.addEventListener("told", () => {
        const photo = `${studio.told?.state.photo} ${studio.told?.state.slice}`;
        if (photo !== this.photo && this.on) this.button.click();
        this.photo = photo;
      });
      this.button.addEventListener("click", () => {
        this.button.setAttribute("aria-pressed", String(!this.on));
        this.begin();
        studio.say(this.on ? POINTS[0] : "", this.on);
      });
    }
    get on() {
      return this.button.getAttribute("aria-pressed") === "true";
    }
    /** Take a point. px: pixels of the photograph in one of the window. */
    async tap(at_px, px) {
      if (this.points.length === POINTS.length) return;
      this.points.push(inPhoto(at_px));
      const photo = studio.told.photo;
      this.drawn.setAttribute("viewBox", `0 0 ${photo.width_px} ${photo.height_px}`);
      this.drawn.replaceChildren(drawnLine(this.drawn, this.points, "sun", px));
      if (this.points.length < POINTS.length) return studio.say(POINTS[this.points.length], true);
      await studio.commit();
      const told = await studio.post("/sun", { points: this.points });
      this.begin();
      if (!told) return;
      this.button.setAttribute("aria-pressed", "false");
      studio.take(told);
      studio.say(told.said);
    }
    begin() {
      this.points = [];
      this.drawn.replaceChildren();
    }
  };

  // src/studio_view.ts
  var MOST = 4;
  var LOOKS_MS = 150;
  var LOUPE_PX = 240;
  var LARGEST_PX = 1600;
  var COARSE = 1.15;
  var View = class {
    stage = byId("stage");
    picture = byId("picture");
    sharp = byId("sharp");
    sharpBefore = byId("sharp_before");
    before = byId("before");
    button = byId("zoom");
    /** Times the fitted size, and what of the photograph lies in the middle of the window, in shares of it. */
    times = 1;
    middle = [0.5, 0.5];
    laid = "";
    looking;
    constructor() {
      this.button.addEventListener("click", () => this.isEnlarged ? this.reset() : this.enlarge());
      studio.addEventListener("state", () => studio.isComplete && (this.sharp.hidden = true));
      studio.addEventListener("picture", () => studio.shown?.draft || this.lookLater());
      studio.addEventListener("before", () => this.before.hidden ? this.sharpBefore.hidden = true : void this.look(this.sharpBefore));
    }
    get isEnlarged() {
      return this.times > 1;
    }
    get room() {
      return byId("room").getBoundingClientRect();
    }
    /** Pixels of the window to one of the photograph where all of it is in sight. */
    get fitted() {
      const photo = studio.told.photo;
      return Math.min(this.room.width / photo.width_px, this.room.height / photo.height_px);
    }
    /** How large pixels of the photograph are on the screen: 1 shows one by one. */
    get scale() {
      return this.fitted * this.times * devicePixelRatio;
    }
    /** Lay the picture out; nothing else does. */
    fit() {
      const photo = studio.told.photo;
      const [room, size] = [this.room, this.fitted * this.times];
      const [width, height] = [photo.width_px * size, photo.height_px * size];
      const place = (share, most, length) => length <= most ? (most - length) / 2 : Math.min(0, Math.max(most - length, most / 2 - share * length));
      const [left, top] = [place(this.middle[0], room.width, width), place(this.middle[1], room.height, height)];
      this.middle = [(room.width / 2 - left) / width, (room.height / 2 - top) / height];
      Object.assign(this.stage.style, { width: `${width}px`, height: `${height}px`, left: `${left}px`, top: `${top}px` });
      studio.pixels = Math.max(4e4, photo.width_px * photo.height_px * (this.fitted * devicePixelRatio) ** 2);
      this.button.setAttribute("aria-pressed", String(this.isEnlarged));
      const told = byId("scale");
      told.hidden = !this.isEnlarged;
      told.textContent = `${Math.round(100 * this.scale)} %`;
      studio.dispatchEvent(new Event("view"));
      const laid = `${width} ${left} ${top}`;
      if (laid !== this.laid) this.lookLater();
      this.laid = laid;
    }
    /** Enlarge about a point of the window, which moved by (dx, dy): what lies under it stays there. */
    by(factor, x, y, dx = 0, dy = 0) {
      if (!studio.told?.photo) return;
      const [room, box] = [this.room, this.stage.getBoundingClientRect()];
      const share = [(x - dx - box.left) / box.width, (y - dy - box.top) / box.height];
      const most = Math.max(MOST, MOST / (this.fitted * devicePixelRatio));
      const times = Math.min(most, Math.max(1, this.times * factor));
      const grown = times / this.times;
      this.times = times;
      this.middle = [share[0] + (room.left + room.width / 2 - x) / (box.width * grown), share[1] + (room.top + room.height / 2 - y) / (box.height * grown)];
      this.fit();
    }
    reset() {
      [this.times, this.middle] = [1, [0.5, 0.5]];
      this.sharp.hidden = this.sharpBefore.hidden = true;
      if (studio.told?.photo) this.fit();
    }
    /** One pixel of the photograph to one of the screen, about the object; twice the size where that is less. */
    enlarge() {
      const [photo, state] = [studio.told?.photo, studio.state];
      if (!photo || !state) return;
      this.times = Math.max(2, 1 / (this.fitted * devicePixelRatio));
      const box = studio.isComplete ? studio.shown?.boxes[state.before.length] : null;
      const high = this.room.height / (photo.height_px * this.fitted * this.times);
      if (box) this.middle = [(box[0] + box[2]) / 2, box[3] - box[1] < high ? (box[1] + box[3]) / 2 : box[3] - 0.3 * high];
      this.fit();
      const hand = matchMedia("(pointer: coarse)").matches ? "two fingers zoom and move the picture" : "Ctrl and the wheel zoom, dragging beside the object moves the picture";
      studio.say(`${hand}; Zoom again shows all of it`);
    }
    /** Left, top, right and bottom of what is in sight, in pixels of the photograph. */
    get inSight() {
      const photo = studio.told.photo;
      const [room, box] = [this.room, this.stage.getBoundingClientRect()];
      const share = (at, from, length) => Math.min(1, Math.max(0, (at - from) / length));
      const [left, right2] = [share(room.left, box.left, box.width), share(room.right, box.left, box.width)];
      const [top, bottom] = [share(room.top, box.top, box.height), share(room.bottom, box.top, box.height)];
      return [left * photo.width_px, top * photo.height_px, right2 * photo.width_px, bottom * photo.height_px];
    }
    /** Bring a pixel of the photograph into sight. */
    reveal([x_px, y_px]) {
      const photo = studio.told.photo;
      const [left, top, right2, bottom] = this.inSight;
      if (x_px > left && x_px < right2 && y_px > top && y_px < bottom) return;
      this.middle = [x_px / photo.width_px, y_px / photo.height_px];
      this.fit();
    }
    /** What is shown is of another picture than before. */
    lookAnew() {
      this.sharp.hidden = this.sharpBefore.hidden = true;
      this.lookLater();
    }
    lookLater() {
      clearTimeout(this.looking);
      if (this.isEnlarged) this.looking = setTimeout(() => void this.lookAgain(), LOOKS_MS);
    }
    async lookAgain() {
      if (!this.before.hidden) await this.look(this.sharpBefore);
      await this.look(this.sharp);
    }
    /** Lay the own pixels of the finished picture, or of the photograph, over the preview, where that is too coarse. */
    async look(sharp) {
      const [timer, photo] = [this.looking, studio.told.photo];
      const coarse = this.stage.clientWidth * devicePixelRatio > COARSE * this.picture.width && this.picture.width < photo.width_px;
      if (!coarse || !this.isEnlarged) return;
      const [left, top, right2, bottom] = this.inSight;
      const side = Math.min(LARGEST_PX, Math.ceil(Math.max(right2 - left, bottom - top)) + 2);
      const [x, y] = [Math.round((left + right2) / 2), Math.round((top + bottom) / 2)];
      const isBefore = sharp === this.sharpBefore;
      const bitmap = await studio.region(x, y, side, isBefore).catch(() => null);
      if (!bitmap || timer !== this.looking || isBefore && this.before.hidden) return;
      [sharp.width, sharp.height] = [side, side];
      sharp.getContext("2d").drawImage(bitmap, 0, 0);
      const percent = (value, most) => `${100 * value / most}%`;
      const [across, down] = [x - Math.floor(side / 2), y - Math.floor(side / 2)];
      Object.assign(sharp.style, { left: percent(across, photo.width_px), top: percent(down, photo.height_px), width: percent(side, photo.width_px), height: percent(side, photo.height_px) });
      sharp.hidden = false;
    }
  };
  var Loupe = class {
    stage = byId("stage");
    picture = byId("picture");
    glass = byId("loupe");
    looking;
    constructor() {
      const button = byId("magnify");
      button.addEventListener("click", () => {
        button.setAttribute("aria-pressed", String(!this.on));
        this.glass.hidden = !this.on;
        this.glass.style.left = "-9999px";
      });
      this.stage.addEventListener("pointermove", (event) => this.on && studio.told?.photo && this.magnify(event));
    }
    get on() {
      return byId("magnify").getAttribute("aria-pressed") === "true";
    }
    magnify(event) {
      const [box, room] = [this.stage.getBoundingClientRect(), byId("room").getBoundingClientRect()];
      const [x, y] = [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
      const photo = studio.told.photo;
      const side = LOUPE_PX * devicePixelRatio;
      this.glass.width = this.glass.height = side;
      const cut = side * this.picture.width / photo.width_px;
      this.glass.getContext("2d").drawImage(this.picture, x * this.picture.width - cut / 2, y * this.picture.height - cut / 2, cut, cut, 0, 0, side, side);
      const within = (value, most) => Math.min(Math.max(0, most - LOUPE_PX), Math.max(0, value));
      Object.assign(this.glass.style, { left: `${within(event.clientX - room.left + 20, room.width)}px`, top: `${within(event.clientY - room.top - LOUPE_PX - 20, room.height)}px` });
      clearTimeout(this.looking);
      this.looking = setTimeout(() => void this.look([x * photo.width_px, y * photo.height_px], side), LOOKS_MS);
    }
    async look([x_px, y_px], side) {
      const timer = this.looking;
      const bitmap = await studio.region(x_px, y_px, side).catch(() => null);
      if (bitmap && timer === this.looking && this.on) this.glass.getContext("2d").drawImage(bitmap, 0, 0, side, side);
      if (bitmap) this.glass.dataset.looked = String(Number(this.glass.dataset.looked ?? 0) + 1);
    }
  };

  // src/studio_picture.ts
  var NUDGES_REST_MS = 500;
  var DRAWN_AGAIN_MS = 900;
  var BESIDE_PX = 12;
  var FINGERS_BESIDE_PX = 48;
  var within180 = (turn_deg) => ((turn_deg + 180) % 360 + 360) % 360 - 180;
  var PictureStage = class {
    stage = byId("stage");
    picture = byId("picture");
    before = byId("before");
    ground = byId("ground");
    view = new View();
    loupe = new Loupe();
    brush = new Brush();
    lines = new Lines();
    shadow = new Shadow();
    photoName = "";
    hint = "";
    from = null;
    moved = [0, 0];
    panning = false;
    /** Whether the fingers that are down shape the object; null before they pinch. */
    shaping = null;
    later;
    quiet;
    constructor() {
      new ResizeObserver(() => this.fit()).observe(byId("room"));
      studio.addEventListener("told", () => this.fit());
      studio.addEventListener("state", () => this.mark());
      studio.addEventListener("view", () => this.mark());
      studio.addEventListener("picture", (event) => this.show(event.detail));
      this.gestures();
      this.keys();
      this.buttons();
    }
    /** Lay the picture out in the window, and load the photograph when it is another one. */
    fit() {
      const photo = studio.told?.photo ?? null;
      this.stage.hidden = !photo;
      byId("welcome").hidden = Boolean(photo);
      if (!photo) return;
      const of = `${photo.name} ${studio.told?.state.photo} ${photo.width_px}`;
      const name = `${of} ${photo.slice ?? ""}`;
      if (name !== this.photoName) {
        if (this.photoName.startsWith(`${of} `)) this.view.lookAnew();
        else this.view.reset();
        this.photoName = name;
        this.hint = "";
        this.before.src = `/photo?of=${encodeURIComponent(name)}`;
        this.before.decode().then(() => studio.isComplete || this.showPhotograph()).catch(() => void 0);
      }
      this.view.fit();
    }
    /** What is to be done next, or what the studio does. */
    next() {
      const [told, state] = [studio.told, studio.state];
      if (told?.busy) return `${told.busy} ...`;
      if (this.hint) return this.hint;
      if (!told?.photo || !state) return "";
      return state.object ? state.at_px ? "" : "Click where the object is to stand" : "Choose an object, or drop a GLB file";
    }
    showPhotograph() {
      this.picture.width = this.before.naturalWidth;
      this.picture.height = this.before.naturalHeight;
      this.picture.getContext("2d").drawImage(this.before, 0, 0);
    }
    show(bitmap) {
      this.picture.width = bitmap.width;
      this.picture.height = bitmap.height;
      this.picture.getContext("2d").drawImage(bitmap, 0, 0);
      bitmap.close();
      this.mark();
    }
    /** Draw grid, horizon, the object's foot and its box. */
    mark() {
      const [photo, state] = [studio.told?.photo ?? null, studio.state];
      const ground = groundOf(photo, state);
      const wanted = byId("grid").getAttribute("aria-pressed") === "true";
      this.stage.classList.toggle("placed", Boolean(state?.at_px));
      const badge = byId("badge");
      badge.textContent = this.next();
      badge.hidden = !badge.textContent;
      this.ground.replaceChildren();
      if (photo) this.ground.setAttribute("viewBox", `0 0 ${photo.width_px} ${photo.height_px}`);
      if (photo && ground && state && wanted) {
        this.path("", ground.grid());
        this.path("horizon", `M0 ${ground.horizon_px(0)}L${photo.width_px} ${ground.horizon_px(photo.width_px)}`);
        studio.objects.forEach((each, number) => {
          const box2 = this.boxOf(number);
          const radius_m = box2 ? ground.length_m(each.at_px, 0.5 * (box2[2] - box2[0]) * photo.width_px) : ground.cell_m / 2;
          this.path(number === state.before.length ? "foot" : "foot other", ground.circle(each.at_px, radius_m));
        });
        const seen = studio.isChanging ? [] : studio.told?.clip?.path_px ?? [];
        if (seen.length) this.path("track", seen.map(([x, y], i) => `${i ? "L" : "M"}${x} ${y}`).join(""));
        const [left, , right2, bottom] = this.view.inSight;
        this.words(`one square: ${ground.cell_m} m`, left + 0.015 * (right2 - left), bottom - 0.015 * (right2 - left), this.px);
      }
      if (photo && !studio.isComplete && this.before.complete && this.before.naturalWidth) this.showPhotograph();
      const box = byId("box");
      const sides = studio.isComplete ? this.boxOf(state.before.length) : null;
      box.hidden = !sides;
      if (sides) {
        const [left, top, right2, bottom] = sides.map((each) => 100 * each);
        Object.assign(box.style, { left: `${left}%`, top: `${top}%`, width: `${right2 - left}%`, height: `${bottom - top}%` });
      }
      this.stage.classList.remove("resting");
      clearTimeout(this.quiet);
      this.quiet = setTimeout(() => this.stage.classList.add("resting"), DRAWN_AGAIN_MS);
    }
    path(kind, data) {
      const path = document.createElementNS(this.ground.namespaceURI, "path");
      path.setAttribute("d", data);
      path.setAttribute("vector-effect", "non-scaling-stroke");
      if (kind) path.setAttribute("class", kind);
      this.ground.append(path);
    }
    words(text, x, y, scale) {
      const words = document.createElementNS(this.ground.namespaceURI, "text");
      words.textContent = text;
      words.setAttribute("transform", `translate(${x} ${y}) scale(${scale})`);
      this.ground.append(words);
    }
    /** The pixel of the photograph under a point of the window. */
    pixel(x, y) {
      const box = this.stage.getBoundingClientRect();
      const photo = studio.told.photo;
      return [(x - box.left) / box.width * photo.width_px, (y - box.top) / box.height * photo.height_px];
    }
    /** Pixels of the photograph in one of the window. */
    get px() {
      return studio.told.photo.width_px / this.stage.clientWidth;
    }
    inside(at_px) {
      const photo = studio.told.photo;
      const ground = groundOf(photo, studio.state);
      const [x, y] = ground ? ground.within(at_px) : at_px;
      const within = (value, most) => Math.round(100 * Math.min(most - 1, Math.max(0, value))) / 100;
      return [within(x, photo.width_px), within(y, photo.height_px)];
    }
    /** The box of an object in the newest picture, if that shows all objects. */
    boxOf(number) {
      const boxes = studio.shown?.boxes ?? [];
      return boxes.length === studio.objects.length ? boxes[number] ?? null : null;
    }
    /** Choose the object under a point of the window, the nearest if several are, unless the chosen one is there. Whether it did. */
    chose(x, y) {
      const [photo, state] = [studio.told?.photo, studio.state];
      if (!photo || !state) return false;
      const [x_px, y_px] = this.pixel(x, y);
      const [u, v] = [x_px / photo.width_px, y_px / photo.height_px];
      const under = studio.objects.flatMap((each, number) => {
        const box = this.boxOf(number);
        return box && u >= box[0] && u <= box[2] && v >= box[1] && v <= box[3] ? [{ number, foot: each.at_px[1] }] : [];
      });
      const nearest = under.sort((one, other) => other.foot - one.foot)[0];
      if (!nearest || under.some((each) => each.number === state.before.length)) return false;
      studio.change(studio.choosing(nearest.number));
      return true;
    }
    /** The button of the tool that waits for a hand on the picture. */
    get tool() {
      return this.brush.on ? "brush" : this.lines.on ? "draw_lines" : this.shadow.on ? "sun_by" : this.stage.classList.contains("focusing") ? "focus_here" : null;
    }
    /** Whether a point of the window lies on the chosen object, or so near beside it. */
    isBy(x, y, beside_px) {
      const box = studio.isComplete ? this.boxOf(studio.state.before.length) : null;
      const stage = this.stage.getBoundingClientRect();
      const [u, v, across, down] = [(x - stage.left) / stage.width, (y - stage.top) / stage.height, beside_px / stage.width, beside_px / stage.height];
      return box !== null && u >= box[0] - across && u <= box[2] + across && v >= box[1] - down && v <= box[3] + down;
    }
    gestures() {
      this.stage.addEventListener("pointerdown", (event) => event.isPrimary && (this.shaping = null), true);
      listen(this.stage, {
        tap: (x, y) => this.tapped(x, y),
        twice: (x, y) => this.tapped(x, y),
        dragStart: (x, y) => {
          if (this.brush.on) return this.brush.start(this.pixel(x, y));
          if (this.lines.on) return this.lines.start(this.pixel(x, y), this.px);
          if (!this.loupe.on) this.chose(x, y);
          this.panning = this.view.isEnlarged && !this.loupe.on && (this.shadow.on || !this.isBy(x, y, BESIDE_PX));
          this.from = studio.state?.at_px ?? this.inside(this.pixel(x, y));
          this.moved = [0, 0];
          this.stage.classList.add("dragging");
        },
        drag: (x, y, dx, dy) => {
          if (this.brush.on) return this.brush.move(this.pixel(x, y));
          if (this.lines.on) return this.lines.move(this.pixel(x, y));
          if (this.panning) return this.view.by(1, x, y, dx, dy);
          if (!this.from || !studio.state?.object || this.loupe.on || this.shadow.on) return;
          this.moved = [this.moved[0] + dx * this.px, this.moved[1] + dy * this.px];
          studio.change({ at_px: this.inside([this.from[0] + this.moved[0], this.from[1] + this.moved[1]]) });
        },
        dragEnd: (pinched) => {
          if (this.brush.on) return pinched ? this.brush.drop() : void this.brush.end();
          if (this.lines.on) return this.lines.stop(this.px, pinched);
          this.from = null;
          this.panning = false;
          this.stage.classList.remove("dragging");
          void studio.commit();
        },
        // Two fingers on the object scale and turn it; elsewhere, while a tool waits, and in the enlarged picture they zoom that.
        pinch: (factor, x, y, dx, dy, turn_deg) => {
          this.shaping ??= this.tool === null && !this.view.isEnlarged && this.isBy(x, y, FINGERS_BESIDE_PX);
          return this.shaping ? this.shape(factor, turn_deg) : this.view.by(factor, x, y, dx, dy);
        },
        wheel: (factor, turn_deg) => this.brush.on ? this.brush.scale(factor) : this.lines.on || this.shadow.on || this.shape(factor, turn_deg),
        zoom: (factor, x, y, dx, dy) => this.view.by(factor, x, y, dx, dy)
      });
    }
    tapped(x, y) {
      this.stage.focus();
      if (!studio.told?.photo) return;
      if (this.brush.on) {
        this.brush.start(this.pixel(x, y));
        return void this.brush.end();
      }
      if (this.lines.on) return this.lines.tap(this.pixel(x, y), this.px);
      if (this.shadow.on) return void this.shadow.tap(this.pixel(x, y), this.px);
      if (this.stage.classList.contains("focusing")) return this.focusAt(x, y);
      if (this.chose(x, y)) return void studio.commit();
      if (!studio.state?.object) return studio.say("choose an object first: in the list at the right, or drop a GLB file");
      const ground = groundOf(studio.told.photo, studio.state);
      if (!ground || ground.isInSight) return void studio.commit({ at_px: this.inside(this.pixel(x, y)) });
      if (studio.told.clip) return studio.say("the first frame shows no ground of the track's world: begin the clip where it does");
      const at_px = this.pixel(x, y);
      void studio.commit({ at_px, camera: null, pitch_deg: ground.usualTilt_deg(at_px) });
      this.hint = "the camera looks up, so that no ground is in sight: another tilt is taken, see Camera and ground";
    }
    /** Scale and turn the object, and keep that once the hand rests. */
    shape(factor, turn_deg) {
      const state = studio.state;
      if (!state?.at_px) return;
      if (factor !== 1) studio.metresTyped = false;
      const turned = turn_deg ? { turn_deg: Number(within180(state.turn_deg + turn_deg).toFixed(2)) } : {};
      studio.change({ height: scaledHeight(state.height, factor), ...turned });
      this.commitLater();
    }
    commitLater() {
      clearTimeout(this.later);
      this.later = setTimeout(() => void studio.commit(), NUDGES_REST_MS);
    }
    /** Focus where one clicked: on the object, on the ground there, or on what the depth shows. */
    focusAt(x, y) {
      const photo = studio.told.photo;
      const at_px = this.inside(this.pixel(x, y));
      byId("focus_here").click();
      if (photo.has_depth) return void studio.commit({ focus_at_px: at_px, focus_m: null });
      const ground = groundOf(photo, studio.state);
      if (!ground) return studio.say("the plain ground has no distance to focus on: turn Plain off, or type the metres");
      const box = this.boxOf(studio.state.before.length);
      const [u, v] = [at_px[0] / photo.width_px, at_px[1] / photo.height_px];
      const onObject = box && u >= box[0] && u <= box[2] && v >= box[1] && v <= box[3];
      const metres = ground.distance_m(onObject && studio.state?.at_px ? studio.state.at_px : at_px);
      if (metres === null) return studio.say("the sky has no distance: click on the ground or the object");
      void studio.commit({ focus_m: Number(metres.toPrecision(4)), focus_at_px: null, camera_height_m: ground.high_m });
    }
    keys() {
      this.stage.addEventListener("keydown", (event) => {
        const state = studio.state;
        if (event.ctrlKey || event.metaKey || event.altKey || !state?.at_px) return;
        const [x, y] = state.at_px;
        const step = event.shiftKey ? 10 : 1;
        const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
        const shapes = { "+": [1.05, 0], "=": [1.05, 0], "-": [1 / 1.05, 0], "[": [1, -step], "]": [1, step], "{": [1, -10], "}": [1, 10] };
        const [move, shape] = [moves[event.key], shapes[event.key]];
        if (move) {
          const at_px = this.inside([x + step * move[0], y + step * move[1]]);
          studio.change({ at_px });
          this.view.reveal(at_px);
          this.commitLater();
        } else if (shape) this.shape(...shape);
        else if (event.key === "Delete" || event.key === "Backspace") studio.remove();
        else return;
        event.preventDefault();
      });
      document.addEventListener("keydown", (event) => {
        const left = this.tool ?? (this.loupe.on ? "magnify" : this.view.isEnlarged ? "zoom" : null);
        if (event.key === "Escape" && left) byId(left).click();
        if (!(event.ctrlKey || event.metaKey) || event.target.matches?.("input[type=text], input[type=number]")) return;
        const key = event.key.toLowerCase();
        if (key !== "z" && key !== "y") return;
        event.preventDefault();
        void studio.step(key === "y" || event.shiftKey ? 1 : -1);
      });
    }
    buttons() {
      const pressed = (id, told) => {
        const button = byId(id);
        button.addEventListener("click", () => {
          const on = button.getAttribute("aria-pressed") !== "true";
          button.setAttribute("aria-pressed", String(on));
          told(on);
        });
      };
      pressed("grid", () => this.mark());
      const tools = ["focus_here", "brush", "draw_lines", "sun_by"];
      const isOn = (id) => byId(id).getAttribute("aria-pressed") === "true";
      for (const id of tools) {
        byId(id).addEventListener("click", () => isOn(id) || tools.filter((each) => each !== id && isOn(each)).forEach((each) => byId(each).click()), true);
      }
      pressed("focus_here", (on) => {
        this.stage.classList.toggle("focusing", on);
        studio.say(on ? "click what is to be in focus: the object, or a place on the ground" : "", on);
      });
      this.stage.addEventListener("pointermove", (event) => {
        if (this.brush.on && studio.told?.photo) this.brush.hover(this.pixel(event.clientX, event.clientY));
      });
      const hold = byId("hold_before");
      const show = (on) => {
        this.before.hidden = !on && byId("brush_hide").getAttribute("aria-pressed") !== "true";
        studio.dispatchEvent(new Event("before"));
      };
      hold.addEventListener("pointerdown", () => show(true));
      for (const end of ["pointerup", "pointercancel", "pointerleave", "blur"]) hold.addEventListener(end, () => show(false));
      hold.addEventListener("keydown", (event) => (event.key === " " || event.key === "Enter") && show(true));
      hold.addEventListener("keyup", () => show(false));
    }
  };

  // src/studio.ts
  async function start() {
    await enter();
    const [picture, panel, histogram] = [new PictureStage(), new Panel(), new Histogram()];
    Object.assign(window, { studio, parts: { picture, panel, histogram } });
    await studio.follow();
  }
  start().catch((problem) => studio.say(problem instanceof Error ? problem.message : "the studio does not answer", true));
})();
