// Job type of Flamenco 3: put this file into the folder `scripts` of the Manager.
const JOB_TYPE = {
    label: "mrbokeh video",
    settings: [
        { key: "frames", type: "string", required: true, default: "1001-1050", description: "Frames as the files are numbered" },
        { key: "chunk_size", type: "int32", default: 10, description: "Frames of one task" },
        { key: "plate", type: "string", required: true, description: "plate.%04d.exr on the shared storage" },
        { key: "rate", type: "string", default: "24", description: "Frames per second, as in the plate's headers if they state it" },
        { key: "layer", type: "string", required: true, description: "cg.%04d.exr" },
        { key: "lens", type: "string", required: true, description: "lens.json, a bank or a network" },
        { key: "out", type: "string", required: true, description: "comp.%04d.exr" },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    for (const chunk of frameChunker(settings.frames, settings.chunk_size)) {
        const task = author.Task(`mrbokeh-${chunk}`, "misc");
        task.addCommand(author.Command("exec", {
            exe: "mrbokeh",
            args: ["video", settings.plate, "--rate", settings.rate, "--layer", settings.layer, "--lens", settings.lens, "--frames", chunk, "--out", settings.out,
                "--overwrite", "--json"],
        }));
        job.addTask(task);
    }
}
