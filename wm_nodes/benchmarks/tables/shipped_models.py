"""Rows of the tables of docs/results/shipped_models.md; what they are about stands in pages.yaml."""

from benchmarks.tables.table import PRETRAINED, Rows, Run, read, share

CUBE, OBJECTS, VIDEO = (f"{PRETRAINED}/{folder}/manifest.json" for folder in (
    "table_top_cube", "table_top_objects", "table_top_cube/video_model"
))
RANGES = ("table_top_cube/normal_ranges_1", "table_top_cube/normal_ranges_2", "table_top_objects/normal_ranges_1")


def cube() -> Rows:
    found, extreme = (read(CUBE)[name] for name in ("heldout", "heldout_extreme"))
    for text, name in (("object that moved, cm", "object_moved"), ("tool, cm", "tool")):
        yield text, *(f"{found[f'{name}_{kind}_cm_h16']:.2f}" for kind in ("rollout", "floor", "copy"))
    kinds = ("rollout", "recon", "copy")
    for text, metrics in (("PSNR, dB", found), ("PSNR under extreme actions, dB", extreme)):
        yield text, *(f"{metrics[f'psnr_{kind}_db_h16']:.1f}" for kind in kinds)
    for text, name in (("SSIM", "ssim"), ("perceptual distance (RS-5a)", "perceptual")):
        yield text, *(f"{found[f'{name}_{kind}_h16']:.2f}" for kind in kinds)
    for step in (4, 16):
        lost = found[f"psnr_shuffled_drop_db_h{step:02d}"]
        yield f"PSNR lost by another episode's actions, step {step}, dB", f"{lost:.1f}", "", ""
    for name in ("object", "tool"):
        yield f"goal: {name}, cm", f"{found[f'goal_{name}_cm']:.1f}", "", f"{found[f'goal_{name}_copy_cm']:.1f}"


def done_signal() -> Rows:
    found = read(CUBE)["heldout"]
    for task in ("push_cube", "reach"):
        recall, *rates = (found[f"done_{task}_{name}"] for name in ("recall", "imagined_rate", "real_rate"))
        called, done = (round(rate * found["episodes"]) for rate in rates)
        hits = round(recall * done)
        cells = (cell for count in (called, done) for cell in (f"{hits} of {count}", share(hits, count)))
        yield task, f"{found[f'done_{task}_auc']:.3f}", *cells


def objects() -> Rows:
    made = read(OBJECTS)
    splits = [made[name] for name in ("heldout", "heldout_ood_object", "heldout_ood_combo")]
    for task in made["tasks"]:
        first, *_ = found = [split[task] for split in splits]
        moved, tool = (
            ["/".join(f"{one[f'{name}_rollout_cm_h16']:.1f}" for one in found),
             *(f"{first[f'{name}_{kind}_cm_h16']:.1f}" for kind in ("latents", "copy"))]
            for name in ("object_moved", "tool")
        )
        done = ("/".join(f"{one[f'done_{task}_{name}']:.2f}" for one in found) for name in ("precision", "recall"))
        last = f"{first['object_moved_rollout_cm_h40']:.1f}"
        moved, last = (["", "", ""], "") if task == "reach_object" else (moved, last)
        yield task, *moved, tool[0], tool[2], *done, last


def pictures_of_objects() -> Rows:
    made = read(OBJECTS)
    for task, found in made["heldout"].items():
        yield (
            task, beside_copy(found, "psnr_{}_db_h16", "rollout"), f"{found['psnr_shuffled_drop_db_h16']:.1f}",
            beside_copy(made["heldout_extreme"][task], "psnr_{}_db_h16", "rollout"),
            *(beside_copy(found, f"goal_{name}{{}}_cm", "", "_copy") for name in ("object", "tool")),
        )


def beside_copy(metrics: Run, pattern: str, ours: str, copy: str = "copy") -> str:
    return "{:.1f} ({:.1f})".format(*(metrics[pattern.format(name)] for name in (ours, copy)))


def video() -> Rows:
    found = read(VIDEO)["heldout"]
    measures = {"object, cm": ("object_cm", 2), "tool, cm": ("tool_cm", 2), "tracking score": ("tracking", 3)}
    for text, (name, digits) in {**measures, "PSNR, dB": ("psnr_db", 1)}.items():
        yield text, *(f"{found[key]:.{digits}f}" for key in (name, f"copy_{name}"))


def normal_ranges() -> Rows:
    for file in RANGES:
        story = read(f"{PRETRAINED}/{file}.json")["story"]
        yield file, story["recordings"], story["clips"], story["seed"]
