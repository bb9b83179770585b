#!/usr/bin/env bash
# All that there is to measure and test on a machine with a GPU, from programs built elsewhere.
#
#   benches/gpu.sh build FOLDER          build the programs into FOLDER (no GPU needed)
#   benches/gpu.sh run FOLDER [CARD]     run them: tests, tables, and the PyTorch peer where python3
#                                        has torch with CUDA; under ten minutes on a data-centre card
#
# CARD is an index, a PCI id or a part of a name, as `fnsf doctor` lists them. FNSF_REAL_DATA names
# a folder with real pairs; without it the simulated street alone is measured.
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"

# The executable that cargo built for one target, from its JSON messages on stdin.
executable() {
  python3 -c '
import json, sys
kind, name = sys.argv[1:]
for line in sys.stdin:
    message = json.loads(line)
    target = message.get("target", {})
    if message.get("executable") and kind in target.get("kind", []) and target["name"] == name:
        print(message["executable"])' "$1" "$2" | tail -1
}

build() {
  local to="$1"
  mkdir -p "$to"
  cd "$here/.."
  place() { install "$(executable "$1" "$2")" "$to/$3"; }
  cargo build --locked --release --bin fnsf --message-format json | place bin fnsf fnsf
  cargo bench --locked --bench gpu --no-run --message-format json | place bench gpu bench-gpu
  cargo bench --locked --bench side_by_side --no-run --message-format json |
    place bench side_by_side bench-side-by-side
  cargo test --locked --release --lib --no-run --message-format json | place lib fnsf test-lib
  cargo test --locked --release --test numerics --no-run --message-format json | place test numerics test-numerics
  strip "$to"/fnsf "$to"/bench-gpu "$to"/bench-side-by-side "$to"/test-lib "$to"/test-numerics
  echo "built into $to: $(du -sh "$to" | cut -f1)"
}

run() {
  local from="$1" card="${2:-}"
  local gpu="gpu${card:+:$card}"
  "$from/fnsf" doctor
  printf '\n## Tests\n\n'
  local log failed=0
  log="$(mktemp)"
  # The first card that there is, and a service whose card is lost in the middle of a job.
  for tests in "test-lib flow::gpu:: app::" "test-numerics gpu::"; do
    # shellcheck disable=SC2086
    FNSF_REQUIRE_GPU=1 "$from"/$tests >"$log" 2>&1 || failed=1
    grep -E '^test result|FAILED|panicked' "$log" || true
  done
  printf '\n## Kernels, objects, pairs, batches\n\n'
  timeout 300 "$from/bench-gpu" ${card:+"$card"} || failed=1
  printf '\n## Lanes of the host\n\n'
  timeout 200 "$from/bench-side-by-side" || failed=1
  local pair="${FNSF_REAL_DATA:-}/av2_7fab/pair.npz"
  if [ ! -f "$pair" ]; then
    echo "FNSF_REAL_DATA names no folder with av2_7fab: no real pair was measured"
    return "$failed"
  fi
  printf '\n## av2_7fab, %s against cpu\n\n' "$gpu"
  for preset in paper neural fnsf-linear nsfp-baseline nsfp-linear; do
    for device in "$gpu" cpu; do
      "$from/fnsf" flow "$pair" -o /tmp/flow.npz --device "$device" --preset "$preset" \
        --max-points 8192 --ground mask --crop-m 51.2 --json &&
        "$from/fnsf" eval /tmp/flow.npz --truth "$pair" --json || failed=1
    done
  done
  printf '\n## The PyTorch peer on the same card\n\n'
  if python3 -c 'import torch; assert torch.cuda.is_available()' 2>/dev/null; then
    for points in "--max-points 8192" ""; do
      # shellcheck disable=SC2086
      timeout 200 python3 "$here/peer/compare.py" "$pair" --fnsf "$from/fnsf" --device "$gpu" \
        --ground mask --crop-m 51.2 $points --seeds 0 1 2 --transforms edt || failed=1
    done
  else
    echo "python3 has no torch with CUDA: the peer was not run"
  fi
  return "$failed"
}

case "${1:-}" in
  build) build "${2:?a folder}" ;;
  run) run "${2:?a folder}" "${3:-}" ;;
  *) sed -n '2,11p' "$0"; exit 2 ;;
esac
