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
  var GATHERING_MS = 1e3;
  async function offerTo(path, peer) {
    await peer.setLocalDescription();
    await gathered(peer);
    const body = peer.localDescription.sdp;
    if (!body.includes("a=candidate:")) throw new Error("this browser has no network address for video");
    const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/sdp" }, body });
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

  // src/camera.ts
  var FOCUS_EVERY_MS = 200;
  var MOST_BITS_PER_S = 4e6;
  var say = (sentence) => {
    document.getElementById("message").textContent = sentence;
  };
  var button = document.getElementById("send");
  var ending = null;
  function target() {
    return new URLSearchParams(location.search).get("to") === "phone-whip" ? "phone-whip" : "whip";
  }
  async function send() {
    const stream = await navigator.mediaDevices.getUserMedia({
      video: { facingMode: "environment", width: { ideal: 1280 }, height: { ideal: 720 }, frameRate: { ideal: 30 } },
      audio: false
    });
    const track = stream.getVideoTracks()[0];
    track.contentHint = "detail";
    const preview = document.getElementById("preview");
    preview.srcObject = stream;
    void preview.play().catch(() => void 0);
    const peer = new RTCPeerConnection({ iceServers: [] });
    let resource = null;
    ending = () => {
      release(resource);
      peer.close();
      track.stop();
      preview.srcObject = null;
      ending = null;
      button.textContent = "Send the camera";
    };
    const sender = peer.addTransceiver(track, { direction: "sendonly", streams: [stream] }).sender;
    tellFocus(peer, track);
    peer.onconnectionstatechange = () => onState(peer);
    resource = await offerTo(`/${target()}`, peer);
    await keepResolution(sender);
    button.textContent = "Stop";
  }
  function onState(peer) {
    if (peer.connectionState === "connected") say("sending");
    if (["failed", "disconnected"].includes(peer.connectionState)) {
      say("the connection was lost");
      ending?.();
    }
  }
  async function keepResolution(sender) {
    const parameters = sender.getParameters();
    parameters.degradationPreference = "maintain-resolution";
    for (const encoding of parameters.encodings) encoding.maxBitrate = MOST_BITS_PER_S;
    await sender.setParameters(parameters).catch(() => void 0);
  }
  function tellFocus(peer, track) {
    const channel = peer.createDataChannel("camera");
    let last;
    const timer = setInterval(() => {
      if (track.readyState === "ended" || peer.connectionState === "closed") return clearInterval(timer);
      const { focusDistance } = track.getSettings();
      if (channel.readyState !== "open" || focusDistance === void 0 || focusDistance === last || focusDistance <= 0) return;
      last = focusDistance;
      channel.send(JSON.stringify({ focusDistance }));
    }, FOCUS_EVERY_MS);
  }
  async function start() {
    if (!window.isSecureContext) {
      say("browsers give the camera to https pages only: start the viewfinder with --tls and a certificate of yours");
      return;
    }
    await enter();
    button.disabled = false;
    say("");
    button.addEventListener("click", () => {
      if (ending) return ending();
      say("connecting");
      send().catch((problem) => {
        ending?.();
        say(problem instanceof Error ? problem.message : "the camera could not be sent");
      });
    });
    window.addEventListener("pagehide", () => ending?.());
  }
  start().catch((problem) => say(problem instanceof Error ? problem.message : "the viewfinder does not answer"));
})();
