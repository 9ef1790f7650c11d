// The colours of depth, as in rsjax/tools/studies/report/depth_view.py: every fifth of its 256 colours, near first.
const STOPS =
  "7a04038b09029b0f01a91601b71d02c32503ce2d04d83706e14109e84b0cef5811f46617f9751dfc8423fe932afea130fdae35faba39f5c53aee" +
  "cf3ae5d938dbe236d0ea34c3f134b7f735a9fb399cfe408bff4b79fe5965fd6952fa7a3ff68a2ff19b22ebaa1ae4b618ddc21ad4d01fc9dd27be" +
  "e92fb2f438a5fb4099ff458cfd4680f64773eb4666dd4559cb424bb53f3e9c3b2f8036215f30123b";
const APART = 5;

function stop(place) {
  return [0, 2, 4].map((at) => parseInt(STOPS.slice(6 * place + at, 6 * place + at + 2), 16));
}

/** Returns [red, green, blue] of a share in 0 … 1: 0 is near. */
export function turbo(share) {
  const at = (Math.max(0, Math.min(1, share)) * 255) / APART;
  const low = Math.min(Math.floor(at), 50);
  const [from, to] = [stop(low), stop(low + 1)];
  return from.map((value, channel) => Math.round(value + (to[channel] - value) * (at - low)));
}

/** Returns the colours of a grey depth picture, 256 × [r, g, b]: grey is linear in metres, colour in 1/depth. */
export function depthColors(near, far, farthest = far) {
  return Array.from({ length: 256 }, (_, grey) => {
    const metres = Math.max(near, Math.min(far, near + (grey / 255) * (farthest - near)));
    return turbo((1 / near - 1 / metres) / (1 / near - 1 / far));
  });
}
