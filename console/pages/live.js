/**
 * Pages that stay up to date.
 */

/**
 * Calls `update` at once and then every `seconds`, while the page is visible, until `signal` aborts.
 * A failure of the first call is thrown. Later ones are passed to `onFailure`, and the calls go on.
 */
export async function repeat(seconds, signal, update, onFailure) {
  await update();
  const again = async () => {
    if (signal.aborted) return;
    try {
      if (!document.hidden) await update();
    } catch (error) {
      if (!signal.aborted) onFailure(error);
    }
    if (!signal.aborted) timer = setTimeout(again, 1000 * seconds);
  };
  let timer = setTimeout(again, 1000 * seconds);
  signal.addEventListener("abort", () => clearTimeout(timer));
}
