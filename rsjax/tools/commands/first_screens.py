"""What each command says first (an example, the output, the options people use) and last (the next step).

One table, so that all commands say it in the same way; ``cli.py`` prints it.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class FirstScreen:
    """The beginning of a command's help, and its last line.

    Attributes:
        example: a line that works, apart from paths.
        output: where the results go.
        used: the options that people use most, at most five, without dashes. A preset may lack one of them.
        following: what to do next, with {run} for the run or store that the command was called with; "" for a command
            that says it itself, or whose output says it.
        takes: how long it takes, where that was measured; "" where it depends on the data alone.
    """

    example: str
    output: str
    used: tuple[str, ...] = ()
    following: str = ""
    takes: str = ""


TINY = "tiny takes 15 to 55 minutes on 2 CPU cores (docs/commands.md says which), debug about a minute"

FIRST_SCREENS = {
    "demo": FirstScreen(
        "rsjax demo",
        "rsjax-demo/: a video and a picture (--out); with a display, a page in the browser",
        ("video", "clip", "out", "port", "data-dir"),
    ),
    "play": FirstScreen(
        "rsjax play tiny",
        "RUN/play: videos and clips that viewers keep (--out)",
        ("port", "host", "policy", "split", "sessions"),
    ),
    "generate": FirstScreen(
        "rsjax generate tiny --clips 0 3 --format gif",
        "RUN/generated: a video for each clip (--out); its path is printed",
        ("clips", "frames", "actions-from", "format", "out"),
        "rsjax play {run} drives the same model; rsjax evaluate {run} scores it",
        "four clips of tiny take about 10 seconds on 2 CPU cores",
    ),
    "train": FirstScreen(
        "rsjax train tiny --run-dir runs/mine",
        "runs/PRESET (--run-dir): weights, report.html, metrics.json",
        ("run-dir", "store", "model", "train.steps", "overwrite"),
        "open {run}/report.html; rsjax play {run} drives the model",
        TINY,
    ),
    "finetune": FirstScreen(
        "rsjax finetune tiny --data lerobot:/data/pusht --out runs/mine",
        "--out: clips, weights, report.html, metrics.json",
        ("data", "out", "steps", "tokenizer", "dry-run"),
        "open {run}/report.html; rsjax play {run} drives the model; docs/finetune.md says how to make it better",
    ),
    "doctor": FirstScreen(
        "rsjax doctor lerobot /data/pusht --option kind=absolute --fix good.json",
        "the terminal: a line for each finding; --fix FILE writes the list of good episodes",
        ("fix", "option", "ignore", "frames", "workers"),
        "rsjax ingest SOURCE PATH --out STORE --selection FILE, with the file of --fix",
    ),
    "ingest": FirstScreen(
        "rsjax ingest lerobot /data/pusht --option kind=absolute --out data/pusht",
        "the store --out, data/SOURCE by default; what was left out is listed in STORE.work",
        ("out", "image-size", "selection", "camera", "workers"),
        "rsjax inspect STORE shows it; rsjax train tiny --store STORE --run-dir runs/mine trains on it",
    ),
    "inspect": FirstScreen(
        "rsjax inspect data/pusht",
        "the terminal, and STORE-sheet.png beside the store (--sheet)",
        ("records", "clips", "sheet", "rerun", "rerun-file"),
        "rsjax train tiny --store {run} --run-dir runs/mine trains on it",
    ),
    "store": FirstScreen(
        "rsjax store merge data/both data/one data/other",
        "a new store: OUT of merge, the folder --into of split",
        (),
        "rsjax inspect STORE shows what is in it",
    ),
    "store merge": FirstScreen(
        "rsjax store merge data/both data/one data/other",
        "OUT, a new store; its path and the number of its clips are printed",
        (),
        "rsjax inspect OUT shows what is in it",
    ),
    "store split": FirstScreen(
        "rsjax store split data/pusht --into data/parts --by task",
        "new stores in the folder --into, one for each label or part; their paths are printed",
        ("into", "by", "parts"),
        "rsjax inspect STORE shows what is in one of them",
    ),
    "store tokenize": FirstScreen(
        "rsjax store tokenize data/pusht --run runs/tiny",
        "a store of tokens beside the clips; its path is printed",
        ("run",),
        "trainings that start from the same tokenizer find these tokens",
    ),
    "export": FirstScreen(
        "rsjax export lerobot data/pusht pusht-clips",
        "OUT, a LeRobotDataset",
        ("version", "split", "state", "codec", "fps"),
        "train on it with LeRobot or openpi (docs/lerobot.md)",
    ),
    "export libero": FirstScreen(
        "rsjax export libero libero-like --demos 40",
        "OUT, a LeRobotDataset with the keys of openpi's data of LIBERO",
        ("demos", "seed", "size", "version", "codec"),
        "train on it with openpi (docs/lerobot.md)",
        "40 demonstrations take about 13 minutes of processor time",
    ),
    "evaluate": FirstScreen(
        "rsjax evaluate runs/tiny --protocol horizon48",
        "RUN/evaluations: result.json for each protocol and split; its path is printed",
        ("protocol", "data", "clips", "horizon", "overwrite"),
        "rsjax compare {run} OTHER sets runs side by side; docs/evaluation.md says what the metrics mean",
        "a run of tiny takes 2 to 4 minutes on 2 CPU cores, the model tiny in the package half a minute",
    ),
    "compare": FirstScreen(
        "rsjax compare runs/tiny runs/genie --protocol run",
        "runs/compare-NAMES (--out): compare.html, .md, .csv and .json",
        ("protocol", "against", "only", "out"),
        "open compare.html, which has film strips as well",
    ),
    "ablation": FirstScreen(
        "rsjax ablation tiny --grid model.depth=none,head --seeds 0 1",
        "runs/ablation-PRESET (--out): a run directory for each cell, and the table",
        ("grid", "seeds", "out", "list", "only"),
        "the same command with --table prints the table again; rsjax compare takes cells as runs",
    ),
    "paper": FirstScreen(
        "rsjax paper --budget 3h",
        "runs/paper (--dir): the trainings, and the report as .html, .md and .json",
        ("budget", "only", "dir", "dry-run", "seeds"),
        "open the report; the same command with a larger --budget runs more of the claims",
        "what --budget says, on 2 CPU cores; --dry-run prints the estimated minutes of each training",
    ),
    "results": FirstScreen(
        "rsjax results --check",
        "docs/results and README.md of the checkout",
        ("add", "study", "run", "name", "check"),
    ),
    "detect": FirstScreen(
        "rsjax detect video.mp4 data/pusht",
        "the terminal: a line for each video or clip; --train writes a detector to --out",
        ("split", "detector", "train", "out", "measure"),
    ),
    "record": FirstScreen(
        "rsjax record runs/tiny --policies runs/tiny/policy_learning/real-200-seed0",
        "RUN/recorded (--out): a store of episodes",
        ("policies", "episodes", "together", "data-dir", "out"),
        "rsjax train tiny with the line above trains on these episodes, too",
    ),
    "adapt": FirstScreen(
        "rsjax adapt runs/tiny --policy runs/tiny/policy_learning/real-200-seed0",
        "RUN-adapted (--out): a run directory for each round, results.json and results.md",
        ("policy", "episodes", "rounds", "minutes", "out"),
        "rsjax policy_evaluation with both runs shows whether policies are judged better",
    ),
    "judge": FirstScreen(
        "rsjax judge runs/tiny",
        "RUN/judge: the weights, and validation.json",
        ("head", "steps", "clips", "store", "data-dir"),
        "rsjax synthesize {run} --judge, rsjax improve {run} and rsjax serve {run} use it from now on",
    ),
    "synthesize": FirstScreen(
        "rsjax synthesize runs/tiny --demos 200",
        "RUN/synthetic (--out): a store, and LeRobotDatasets v3.0 and v2.1",
        ("demos", "noise", "judge", "store", "out"),
        "rsjax policy_learning {run} trains policies on them; docs/lerobot.md says how to train others",
        "tiny generates about 12 demonstrations a second on 2 CPU cores; writing them is not counted",
    ),
    "policy_learning": FirstScreen(
        "rsjax policy_learning runs/tiny --counts 50 200",
        "RUN/policy_learning (--out): the policies, results.json, results.md, success.png",
        ("counts", "seeds", "episodes", "synthetic", "out"),
        "rsjax play {run} --policy DIR watches one of them; rsjax policy_evaluation {run} judges policies in the model",
    ),
    "policy_evaluation": FirstScreen(
        "rsjax policy_evaluation runs/tiny runs/genie",
        "RUN/policy_evaluation (--out) of the first run: results.json, results.md, scatter.png, videos",
        ("episodes", "policies", "judge", "trainings", "out"),
        "the videos show simulator and model side by side; --blind DIR has people judge them",
    ),
    "improve": FirstScreen(
        "rsjax improve runs/tiny --demos 50",
        "RUN/improve (--out): the policies, results.json, results.md, success.png",
        ("demos", "policy", "rounds", "imagined", "out"),
        "rsjax play {run} --policy DIR watches the new policy",
    ),
    "plan": FirstScreen(
        "rsjax plan runs/tiny --energy judge --episodes 50",
        "RUN/plan/KEY: result.json, results.md, videos",
        ("energy", "methods", "episodes", "horizon", "candidates"),
        "the videos beside result.json show each way to act",
    ),
    "serve": FirstScreen(
        "rsjax serve tiny",
        "the address that it prints; nothing is written",
        ("port", "host", "clients", "frames", "lanes"),
    ),
    "save": FirstScreen(
        "rsjax save runs/tiny mine",
        "OUT: config.json, model.safetensors, README.md, clips",
        ("dtype", "clips", "measured", "license", "note"),
        'rsjax play OUT, rsjax.load("OUT"), or rsjax hub push OUT USER/NAME',
    ),
    "hub": FirstScreen(
        "rsjax hub pull USER/NAME mine",
        "push: the repository USER/NAME of the hub; pull: the directory MODEL",
    ),
    "hub push": FirstScreen(
        "rsjax hub push mine USER/NAME --private",
        "the repository USER/NAME of the hub; the address of the commit is printed",
        ("private",),
    ),
    "hub pull": FirstScreen(
        "rsjax hub pull USER/NAME mine",
        "the directory MODEL; its path is printed",
        ("revision",),
    ),
    "describe": FirstScreen(
        "rsjax describe roboscape_s",
        "the terminal; --json prints the numbers as JSON",
        ("json", "model", "model.width", "model.blocks", "train.batch-size"),
        "rsjax compile PRESET --target h100x8 says how fast it could be there; rsjax bench PRESET measures it here",
    ),
    "compile": FirstScreen(
        "rsjax compile roboscape_s --target h100x8",
        "the terminal; --json FILE and --dump FILE write numbers and program",
        ("target", "part", "json", "dump", "train.batch-size"),
        "docs/compile.md says how to read the numbers; docs/cluster.md how to train there",
    ),
    "bench": FirstScreen(
        "rsjax bench genie_35m --batch 1 --json bench.json",
        "the terminal; --json FILE, written after each part",
        ("batch", "only", "horizons", "torch", "json"),
        "docs/performance.md has the numbers of other machines",
    ),
    "convert": FirstScreen(
        "rsjax convert genie /downloads/GENIE_138M weights/genie-138m",
        "OUT, a directory that --train.start-from takes, or a .safetensors file",
        ("weights", "part", "net", "heads", "task"),
        "docs/convert.md says which command takes what was written",
    ),
    "replay": FirstScreen(
        "rsjax replay runs/tiny --step 812",
        "the terminal: a line for each skipped step, or for each clip of one",
        ("step", "stage", "data-dir", "store"),
    ),
}
