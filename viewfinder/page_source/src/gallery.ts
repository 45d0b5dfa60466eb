// <vf-gallery>: the takes and captures that were saved, to play, keep and delete.
import { model } from "./model";
import { sentenceOf } from "./server";

interface Listed {
  name: string;
  kind: "take" | "capture";
  size_bytes: number;
  made_s: number;
  length_s: number | null;
}

const ANSWER_S = 6;
const SURE_MS = 4000;

export class Gallery extends HTMLElement {
  private dialog!: HTMLDialogElement;
  private list!: HTMLElement;

  connectedCallback(): void {
    this.innerHTML = `<button id="open_gallery" hidden>Saved</button>
      <dialog id="gallery" aria-label="saved takes and captures">
        <header><h2>Saved</h2><span id="room"></span><button id="close_gallery">Close</button></header>
        <div id="playing"></div>
        <ul id="saved"></ul>
      </dialog>`;
    this.dialog = this.querySelector("#gallery")!;
    this.list = this.querySelector("#saved")!;
    this.querySelector("#open_gallery")!.addEventListener("click", () => void this.open());
    this.querySelector("#close_gallery")!.addEventListener("click", () => this.dialog.close());
    // What plays stops with the dialog.
    this.dialog.addEventListener("close", () => this.querySelector("#playing")!.replaceChildren());
    model.addEventListener("state", () => (this.querySelector<HTMLElement>("#open_gallery")!.hidden = model.state?.gallery !== true));
  }

  private async open(): Promise<void> {
    if (await this.refresh()) this.dialog.showModal();
  }

  /** Whether the server gave a list. */
  private async refresh(): Promise<boolean> {
    const answer = await fetch("/gallery").catch(() => null);
    if (!answer?.ok) {
      model.say(answer ? await sentenceOf(answer) : "the viewfinder does not answer", ANSWER_S);
      return false;
    }
    const { saved: all, free_bytes } = (await answer.json()) as { saved: Listed[]; free_bytes: number };
    this.querySelector("#room")!.textContent = `${(free_bytes / 1e9).toFixed(1)} GB free`;
    this.list.replaceChildren(...all.map((each) => this.entry(each)));
    if (all.length === 0) this.list.textContent = "Nothing was saved yet: the red button records, the white one captures.";
    return true;
  }

  private entry(listed: Listed): HTMLElement {
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

  private show(listed: Listed): void {
    const shown = document.createElement(listed.kind === "take" ? "video" : "img");
    shown.src = path(listed, "shown");
    if (shown instanceof HTMLVideoElement) Object.assign(shown, { controls: true, autoplay: true, playsInline: true, muted: true });
    else shown.alt = `capture ${listed.name}`;
    this.querySelector("#playing")!.replaceChildren(shown);
    this.dialog.scrollTo(0, 0);
  }

  /** At the second press: what is deleted is gone. */
  private async erase(listed: Listed, pressed: HTMLButtonElement): Promise<void> {
    if (pressed.dataset["sure"] === undefined) {
      pressed.dataset["sure"] = "";
      pressed.textContent = "Really?";
      setTimeout(() => {
        delete pressed.dataset["sure"];
        pressed.textContent = "Delete";
      }, SURE_MS);
      return;
    }
    this.querySelector("#playing")!.replaceChildren();
    const answer = await fetch(path(listed, ""), { method: "DELETE" }).catch(() => null);
    if (!answer?.ok) model.say(answer ? await sentenceOf(answer) : "the viewfinder does not answer", ANSWER_S);
    await this.refresh();
  }
}

function path(listed: Listed, what: string): string {
  return `/gallery/${encodeURIComponent(listed.name)}${what && "/"}${what}`;
}

function button(text: string, press: () => void): HTMLButtonElement {
  const made = document.createElement("button");
  made.textContent = text;
  made.addEventListener("click", press);
  return made;
}

function length(length_s: number | null): string {
  return length_s === null ? "" : `${Math.floor(length_s / 60)}:${String(Math.round(length_s) % 60).padStart(2, "0")}`;
}

function megabytes(size_bytes: number): string {
  return `${(size_bytes / 1e6).toFixed(1)} MB`;
}
