/**
 * The state of a viewer: its settings, and what the last picture shows.
 */

/** Whether a scene has more sweeps than those of one pair. */
export function isSequence(scene) {
  return scene.sweeps > 2;
}

/**
 * The state in which a viewer begins. A pair shows where its flow leads, a sequence its first sweep.
 *
 * @param {Object} scene
 * @returns {Object}
 */
export function initialState(scene) {
  return {
    // Share of the way from the source's time to the target's, 0 to 1.
    time: isSequence(scene) ? 0 : 1,
    sweep: 0,
    speed: 1,
    isPlaying: false,
    color: "height",
    denseColor: "height",
    // The least confidence that is shown, 0 to 1.
    confidence: 0,
    ground: true,
    ego: false,
    mode: scene.sweeps === 0 ? "dense" : "sweeps",
    layers: { moved: true, source: false, target: true, boxes: true, still: false, tracks: true, grid: true },
    camera: "free",
    isMeasuring: false,
    // Places between which a distance is measured, metres.
    measured: [],
    // Null, or `kind` ("point" or "object"), `layer`, `row`, `cluster`, `id` of the track, `key` of the object.
    picked: null,
    hasTracks: false,
    // Places of visible boxes on the canvas: `x`, `y` in CSS pixels, `cluster`, `id`.
    boxes: [],
    pointsDrawn: 0,
    frames: 0,
    lastFrameMs: 0,
    firstPictureMs: null,
  };
}
