// The session's branches, and what is known of their frames. Frames up to a fork belong to the branch forked from.

/** Makes an empty tree. */
export function makeTree() {
  const branches = new Map();
  const frames = new Map(); // "branch kind frame" → {data, width, height, scale}
  const scores = new Map(); // branch → array of PSNR by frame
  const coverage = new Map(); // "branch frame" → share of the training frames that are nearer to the others
  const points = new Map(); // "branch pane frame" → [[x, y, visible], …]

  function clear() {
    for (const each of [branches, frames, scores, coverage, points]) each.clear();
  }

  function setBranch({ branch, parent, fork, length, draw }) {
    branches.set(branch, { branch, parent, fork, length, draw });
  }

  /** Returns the branch whose own a frame is. */
  function owner(branch, frame) {
    let at = branches.get(branch);
    while (at && at.parent !== null && frame <= at.fork) at = branches.get(at.parent);
    return at ? at.branch : branch;
  }

  function putFrame(frame) {
    frames.set(`${frame.branch} ${frame.kind} ${frame.frame}`, frame);
    const branch = branches.get(frame.branch);
    if (branch && frame.kind === "rgb") branch.length = Math.max(branch.length, frame.frame + 1);
  }

  function frame(branch, kind, number) {
    return frames.get(`${owner(branch, number)} ${kind} ${number}`) ?? frames.get(`${branch} ${kind} ${number}`);
  }

  function putScore({ branch, frame: number, psnr, psnr_mean: mean }) {
    if (!scores.has(branch)) scores.set(branch, []);
    scores.get(branch)[number] = { psnr, mean };
  }

  function score(branch, number) {
    return scores.get(owner(branch, number))?.[number] ?? scores.get(branch)?.[number];
  }

  /** Returns the PSNR of each of a branch's frames; undefined where there is none. */
  function psnr(branch) {
    return Array.from({ length: length(branch) }, (_, number) => score(branch, number)?.psnr ?? undefined);
  }

  function putCoverage({ branch, frame: number, coverage: share }) {
    if (share !== null) coverage.set(`${branch} ${number}`, share);
  }

  /** Returns the share of the training frames that are nearer to the others than this one is; undefined if unknown. */
  function coverageAt(branch, number) {
    return coverage.get(`${owner(branch, number)} ${number}`) ?? coverage.get(`${branch} ${number}`);
  }

  function putPoints({ branch, pane, frame: number, points: each }) {
    points.set(`${branch} ${pane} ${number}`, each);
  }

  function pointsAt(branch, pane, number) {
    return points.get(`${owner(branch, number)} ${pane} ${number}`) ?? points.get(`${branch} ${pane} ${number}`);
  }

  function length(branch) {
    return branches.get(branch)?.length ?? 0;
  }

  /** Returns the branches in the order of a tree: each after the one that it left, with its depth. */
  function ordered(parent = null, depth = 0) {
    const children = [...branches.values()].filter((each) => each.parent === parent);
    return children.flatMap((each) => [{ ...each, depth }, ...ordered(each.branch, depth + 1)]);
  }

  function remove(branch) {
    branches.delete(branch);
    scores.delete(branch);
    for (const map of [frames, coverage, points]) for (const key of map.keys()) if (key.startsWith(`${branch} `)) map.delete(key);
  }

  return { branches, owner, clear, setBranch, putFrame, frame, putScore, score, psnr, putCoverage, coverageAt, putPoints, pointsAt, length, ordered, remove };
}
