// Talking to the server: letting oneself in, the state, control messages, and the exchange of WHEP and WHIP.
import { model, type State } from "./model";

// Talking to the server: letting oneself in, the state, and control messages.
type Message = Record<string, unknown>;
type Answer = Message & { done?: string; error?: string };

const ANSWER_S = 6;
// A finger on a slider moves 60 to 120 times a second; the server takes 40 messages.
const PACE_MS = 50;

export const pace = (): Promise<void> => new Promise((done) => setTimeout(done, PACE_MS));

/** Exchange the token of the address for a cookie; the token leaves the address, so that it is in no bookmark. */
export async function enter(): Promise<void> {
  const token = new URLSearchParams(location.hash.slice(1)).get("token");
  if (token === null) return;
  history.replaceState(null, "", location.pathname + location.search);
  const answer = await fetch("/enter", posted({ token }));
  // Who is in already may open a spent address again.
  if (!answer.ok && (await fetch("/state")).status === 401) throw new Error(await sentenceOf(answer));
}

export async function refreshState(): Promise<State> {
  const answer = await fetch("/state");
  if (!answer.ok) throw new Error(await sentenceOf(answer));
  const state = (await answer.json()) as State;
  model.setState(state);
  return state;
}

/** Send a control message; null, and the sentence shown, where it was refused. */
export async function control(message: Message): Promise<Answer | null> {
  try {
    const answer = await fetch("/control", posted(message));
    const body = (await answer.json()) as Answer;
    if (body.error === undefined) return body;
    model.say(body.error, ANSWER_S);
  } catch {
    model.say("the viewfinder does not answer", ANSWER_S);
  }
  return null;
}

const latest = new Map<string, { next: Message | null }>();

/** Like control, one message per kind at a time: of those that come meanwhile only the last is sent. */
export async function controlLatest(kind: string, message: Message): Promise<void> {
  const busy = latest.get(kind);
  if (busy) {
    busy.next = message;
    return;
  }
  const turn: { next: Message | null } = { next: message };
  latest.set(kind, turn);
  while (turn.next) {
    const now = turn.next;
    turn.next = null;
    await control(now);
    await pace();
  }
  latest.delete(kind);
}

export async function sentenceOf(answer: Response): Promise<string> {
  const text = await answer.text();
  try {
    return (JSON.parse(text) as Answer).error ?? answer.statusText;
  } catch {
    return text.slice(0, 200) || `the viewfinder answered ${answer.status}`;
  }
}

function posted(message: Message): RequestInit {
  return { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(message) };
}

// The exchange of WHEP and WHIP: the offer is posted, the answer comes back, the Location is the connection's own address.
const GATHERING_MS = 1000;

/** Offer a peer connection; the address at which it ends with DELETE, or null if the server named none. */
export async function offerTo(path: string, peer: RTCPeerConnection): Promise<string | null> {
  await peer.setLocalDescription();
  await gathered(peer);
  const body = peer.localDescription!.sdp;
  // Where there is no network browsers have no address for it, and the connection would be waited for in vain.
  if (!body.includes("a=candidate:")) throw new Error("this browser has no network address for video");
  const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/sdp" }, body });
  if (!answer.ok) throw new Error(await sentenceOf(answer));
  await peer.setRemoteDescription({ type: "answer", sdp: await answer.text() });
  return answer.headers.get("Location");
}

/** Tell the server that a connection ended, also while the page closes. */
export function release(resource: string | null): void {
  if (resource !== null) void fetch(resource, { method: "DELETE", keepalive: true }).catch(() => undefined);
}

/** On a local network all addresses are known at once; what is slow is not worth waiting for. */
function gathered(peer: RTCPeerConnection): Promise<void> {
  return new Promise((done) => {
    if (peer.iceGatheringState === "complete") return done();
    setTimeout(done, GATHERING_MS);
    peer.addEventListener("icegatheringstatechange", () => peer.iceGatheringState === "complete" && done());
  });
}
