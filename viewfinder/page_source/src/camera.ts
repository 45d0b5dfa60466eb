// The page that sends this device's camera (WHIP) to the viewfinder.
import { enter, offerTo, release } from "./server";

const FOCUS_EVERY_MS = 200;
const MOST_BITS_PER_S = 4_000_000;

const say = (sentence: string): void => {
  document.getElementById("message")!.textContent = sentence;
};
const button = document.getElementById("send") as HTMLButtonElement;
let ending: (() => void) | null = null;

/** Where the camera goes: the viewfinder's own picture, or with ?to=phone-whip the phone that stands on a camera. */
function target(): string {
  return new URLSearchParams(location.search).get("to") === "phone-whip" ? "phone-whip" : "whip";
}

async function send(): Promise<void> {
  const stream = await navigator.mediaDevices.getUserMedia({
    video: { facingMode: "environment", width: { ideal: 1280 }, height: { ideal: 720 }, frameRate: { ideal: 30 } },
    audio: false,
  });
  const track = stream.getVideoTracks()[0]!;
  // Fewer frames rather than fewer pixels: the tracking looks for corners.
  track.contentHint = "detail";
  const preview = document.getElementById("preview") as HTMLVideoElement;
  preview.srcObject = stream;
  void preview.play().catch(() => undefined);

  const peer = new RTCPeerConnection({ iceServers: [] });
  let resource: string | null = null;
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

function onState(peer: RTCPeerConnection): void {
  if (peer.connectionState === "connected") say("sending");
  if (["failed", "disconnected"].includes(peer.connectionState)) {
    say("the connection was lost");
    ending?.();
  }
}

async function keepResolution(sender: RTCRtpSender): Promise<void> {
  const parameters = sender.getParameters() as RTCRtpSendParameters & { degradationPreference?: string };
  parameters.degradationPreference = "maintain-resolution";
  for (const encoding of parameters.encodings) encoding.maxBitrate = MOST_BITS_PER_S;
  await sender.setParameters(parameters).catch(() => undefined);
}

/** Where the lens is focused, in metres, from the few browsers that know. */
function tellFocus(peer: RTCPeerConnection, track: MediaStreamTrack): void {
  const channel = peer.createDataChannel("camera");
  let last: number | undefined;
  const timer = setInterval(() => {
    if (track.readyState === "ended" || peer.connectionState === "closed") return clearInterval(timer);
    const { focusDistance } = track.getSettings() as MediaTrackSettings & { focusDistance?: number };
    if (channel.readyState !== "open" || focusDistance === undefined || focusDistance === last || focusDistance <= 0) return;
    last = focusDistance;
    channel.send(JSON.stringify({ focusDistance }));
  }, FOCUS_EVERY_MS);
}

async function start(): Promise<void> {
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
    send().catch((problem: unknown) => {
      ending?.();
      say(problem instanceof Error ? problem.message : "the camera could not be sent");
    });
  });
  window.addEventListener("pagehide", () => ending?.());
}

start().catch((problem: unknown) => say(problem instanceof Error ? problem.message : "the viewfinder does not answer"));
