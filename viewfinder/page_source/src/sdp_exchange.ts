// The exchange of WHEP and WHIP: the offer is posted, the answer comes back, the Location is the connection's own address.
import { sentenceOf } from "./server";

const GATHERING_MS = 1000;

/** Offer a peer connection; the address at which it ends with DELETE, or null if the server named none. */
export async function offerTo(path: string, peer: RTCPeerConnection): Promise<string | null> {
  await peer.setLocalDescription();
  await gathered(peer);
  const body = peer.localDescription!.sdp;
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
