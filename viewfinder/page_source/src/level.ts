// The level: how this phone is tilted, from the angles of deviceorientation, which browsers give to secure pages only.

export const levelAllowed = window.isSecureContext && "DeviceOrientationEvent" in window;

/** iOS asks its user, and only in answer to a touch; true if the angles will come. */
export async function askForLevel(): Promise<boolean> {
  const kind = DeviceOrientationEvent as unknown as { requestPermission?: () => Promise<string> };
  return !kind.requestPermission || (await kind.requestPermission().catch(() => "denied")) === "granted";
}

/** Where up is, seen on the screen: [right, up, towards the eye], of length 1. Angles in degrees; screen: of screen.orientation. */
export function upOnScreen(beta: number, gamma: number, screen: number): [number, number, number] {
  const [b, g, s] = [beta, gamma, screen].map((angle) => (angle * Math.PI) / 180) as [number, number, number];
  // The last row of Rz(alpha) Rx(beta) Ry(gamma), as the W3C's Device Orientation defines the angles.
  const [x, y, z] = [-Math.cos(b) * Math.sin(g), Math.sin(b), Math.cos(b) * Math.cos(g)];
  return [x * Math.cos(s) - y * Math.sin(s), x * Math.sin(s) + y * Math.cos(s), z];
}

export function showLevel(line: HTMLElement, active: () => boolean): void {
  if (!levelAllowed) return;
  window.addEventListener("deviceorientation", (event) => {
    line.hidden = !active() || event.beta === null || event.gamma === null;
    if (line.hidden) return;
    const [right, up, towards] = upOnScreen(event.beta!, event.gamma!, screen.orientation?.angle ?? 0);
    const roll = (Math.atan2(right, up) * 180) / Math.PI;
    // Where the screen faces up its camera looks down, and the horizon lies higher; the whole height for a right angle.
    const down = Math.asin(Math.max(-1, Math.min(1, towards))) / (Math.PI / 2);
    line.style.transform = `translateY(${-100 * down}%) rotate(${roll}deg)`;
    line.classList.toggle("even", Math.abs(roll) < 0.7);
  });
}
