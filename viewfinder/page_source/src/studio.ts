// The studio's page: an object is placed in a photograph, and seen with the blur of its lens at once.
import { enter } from "./server";
import { studio } from "./studio_model";
import { Histogram } from "./studio_histogram";
import { Panel } from "./studio_panel";
import { PictureStage } from "./studio_picture";

async function start(): Promise<void> {
  await enter();
  const [picture, panel, histogram] = [new PictureStage(), new Panel(), new Histogram()];
  // What tests and the curious read in the console.
  Object.assign(window, { studio, parts: { picture, panel, histogram } });
  await studio.follow();
}

start().catch((problem: unknown) => studio.say(problem instanceof Error ? problem.message : "the studio does not answer", true));
