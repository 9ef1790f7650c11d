"""Meta-World's 50 tasks: which are simple, and the splits of its meta-learning benchmarks."""

# Simple are the 28 tasks that Seo et al. call easy (Masked World Models for Visual Control, arXiv 2206.14244): mostly
# one motion that reaches a point or moves a mechanism, such as pressing or turning. Difficult are the 22 that they call
# medium, hard and very hard: a free object has to be grasped, pushed or used as a tool.
SIMPLE = (
    "button-press",
    "button-press-topdown",
    "button-press-topdown-wall",
    "button-press-wall",
    "coffee-button",
    "dial-turn",
    "door-close",
    "door-lock",
    "door-open",
    "door-unlock",
    "drawer-close",
    "drawer-open",
    "faucet-close",
    "faucet-open",
    "handle-press",
    "handle-press-side",
    "handle-pull",
    "handle-pull-side",
    "lever-pull",
    "peg-unplug-side",
    "plate-slide",
    "plate-slide-back",
    "plate-slide-back-side",
    "plate-slide-side",
    "reach",
    "reach-wall",
    "window-close",
    "window-open",
)
DIFFICULT = (
    "assembly",
    "basketball",
    "bin-picking",
    "box-close",
    "coffee-pull",
    "coffee-push",
    "disassemble",
    "hammer",
    "hand-insert",
    "peg-insert-side",
    "pick-out-of-hole",
    "pick-place",
    "pick-place-wall",
    "push",
    "push-back",
    "push-wall",
    "shelf-place",
    "soccer",
    "stick-pull",
    "stick-push",
    "sweep",
    "sweep-into",
)
TASKS = tuple(sorted(SIMPLE + DIFFICULT))

# Meta-World's own splits into training tasks and tasks that are held out.
ML10 = (
    "basketball",
    "button-press-topdown",
    "door-open",
    "drawer-close",
    "peg-insert-side",
    "pick-place",
    "push",
    "reach",
    "sweep",
    "window-open",
)
ML10_UNSEEN = ("door-close", "drawer-open", "lever-pull", "shelf-place", "sweep-into")
ML45_UNSEEN = ("bin-picking", "box-close", "door-lock", "door-unlock", "hand-insert")
ML45 = tuple(task for task in TASKS if task not in ML45_UNSEEN)
