// Focus peaking, zebra and histogram, measured in the browser on the picture as it arrived (compressed), in one WebGL2 pass.
import { model } from "./model";

export interface Marking {
  peakReal: boolean;
  peakVirtual: boolean;
  zebra: boolean;
}

const VERTEX = `#version 300 es
out vec2 at;
void main() {
  vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  at = vec2(0.5 + 0.5 * corner.x, 0.5 - 0.5 * corner.y);
  gl_Position = vec4(corner, 0.0, 1.0);
}`;

// An edge is in focus where luma changes within 2 px nearly as much as in the whole neighbourhood, 6 px wide, whatever its contrast: for a
// step blurred by a Gaussian of s px that is erf(1 / (s sqrt 2)) / erf(3 / (s sqrt 2)), above 0.6 up to s = 1.2. Less than 0.1 in 2 px is
// noise; more than 0.35 is in focus also where detail is denser than the neighbourhood. What is covered at least half counts as virtual.
// Alpha is premultiplied.
const FRAGMENT = `#version 300 es
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

const BINS = 64;
const MEASURED = { width: 96, height: 54 };

export class Marks {
  private readonly gl: WebGL2RenderingContext;
  private readonly program: WebGLProgram;
  private readonly picture: WebGLTexture;
  private readonly matte: WebGLTexture;
  private readonly small: WebGLFramebuffer;
  private readonly read = new Uint8Array(4 * MEASURED.width * MEASURED.height);

  /** Null where the browser has no WebGL2. */
  static on(canvas: HTMLCanvasElement): Marks | null {
    const gl = canvas.getContext("webgl2", { premultipliedAlpha: true, antialias: false, depth: false });
    return gl ? new Marks(canvas, gl) : null;
  }

  private constructor(private readonly canvas: HTMLCanvasElement, gl: WebGL2RenderingContext) {
    this.gl = gl;
    this.program = program(gl);
    this.picture = texture(gl, gl.LINEAR);
    this.matte = texture(gl, gl.LINEAR);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    const target = texture(gl, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, MEASURED.width, MEASURED.height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    this.small = gl.createFramebuffer()!;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.small);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
  }

  setMatte(matte: ImageBitmap): void {
    this.upload(this.matte, matte);
  }

  /** Draw the marks of a picture over it. */
  draw(pixels: HTMLCanvasElement | HTMLVideoElement, marking: Marking): void {
    const [width, height] = sizeOf(pixels);
    if (!width || !height) return;
    if (this.canvas.width !== width || this.canvas.height !== height) [this.canvas.width, this.canvas.height] = [width, height];
    this.upload(this.picture, pixels);
    this.pass(null, width, height, marking);
  }

  /** How many of the picture's pixels have each luma, darkest first, of the picture drawn last; the highest bin is 1. */
  histogram(): number[] {
    const { width, height } = MEASURED;
    this.pass(this.small, width, height, { peakReal: false, peakVirtual: false, zebra: false });
    this.gl.readPixels(0, 0, width, height, this.gl.RGBA, this.gl.UNSIGNED_BYTE, this.read);
    const bins = new Array<number>(BINS).fill(0);
    for (let i = 0; i < this.read.length; i += 4) bins[(this.read[i]! * BINS) >> 8]! += 1;
    const highest = Math.max(...bins);
    return bins.map((count) => count / highest);
  }

  clear(): void {
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
    this.gl.clearColor(0, 0, 0, 0);
    this.gl.clear(this.gl.COLOR_BUFFER_BIT);
  }

  private pass(target: WebGLFramebuffer | null, width: number, height: number, marking: Marking): void {
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

  private uniform(name: string): WebGLUniformLocation | null {
    return this.gl.getUniformLocation(this.program, name);
  }

  private upload(target: WebGLTexture, pixels: TexImageSource): void {
    this.gl.activeTexture(this.gl.TEXTURE0);
    this.gl.bindTexture(this.gl.TEXTURE_2D, target);
    this.gl.texImage2D(this.gl.TEXTURE_2D, 0, this.gl.RGBA, this.gl.RGBA, this.gl.UNSIGNED_BYTE, pixels);
  }
}

export function sizeOf(pixels: HTMLCanvasElement | HTMLVideoElement): [number, number] {
  return pixels instanceof HTMLVideoElement ? [pixels.videoWidth, pixels.videoHeight] : [pixels.width, pixels.height];
}

function program(gl: WebGL2RenderingContext): WebGLProgram {
  const linked = gl.createProgram()!;
  for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]] as const) {
    const shader = gl.createShader(kind)!;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(linked, shader);
  }
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS)) throw new Error(`the marks do not compile: ${gl.getProgramInfoLog(linked)}`);
  return linked;
}

function texture(gl: WebGL2RenderingContext, filter: number): WebGLTexture {
  const made = gl.createTexture()!;
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return made;
}

// The histogram of luma, drawn a few times a second: counting costs more than drawing.
const HISTOGRAM_EVERY_MS = 200;

export class Histogram {
  private last_ms = 0;

  constructor(private readonly canvas: HTMLCanvasElement) {}

  draw(marks: Marks): void {
    const now = performance.now();
    if (now - this.last_ms < HISTOGRAM_EVERY_MS) return;
    this.last_ms = now;
    const { width, height } = this.canvas;
    const context = this.canvas.getContext("2d")!;
    const bins = marks.histogram();
    context.clearRect(0, 0, width, height);
    context.fillStyle = "#e8e6e1";
    const step = width / bins.length;
    // Roots show the few pixels of lights and shadows beside the many between.
    bins.forEach((share, i) => context.fillRect(i * step, height * (1 - Math.sqrt(share)), step, height));
  }
}

// The coverage of the virtual layer, fetched a few times a second while peaking needs to tell real from virtual.
const MATTE_EVERY_MS = 200;

export class MatteFeed {
  private running = false;

  constructor(private readonly take: (matte: ImageBitmap) => void) {}

  run(on: boolean): void {
    if (on && !this.running) void this.loop();
    this.running = on;
  }

  private async loop(): Promise<void> {
    // Begun before `running` is set.
    await Promise.resolve();
    while (this.running) {
      if (model.state?.matte) await this.fetchOne().catch(() => undefined);
      await new Promise((done) => setTimeout(done, MATTE_EVERY_MS));
    }
  }

  private async fetchOne(): Promise<void> {
    const answer = await fetch("/matte");
    if (!answer.ok) return;
    const bitmap = await createImageBitmap(await answer.blob());
    this.take(bitmap);
    bitmap.close();
  }
}
