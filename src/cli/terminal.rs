//! Progress bars, and the command line's `Control`: a clock and one of them.

use std::time::Instant;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::flow::{Control, Progress};

/// Keeps time. Shows progress and loss where stderr is a terminal.
pub(super) struct Terminal {
    began: Instant,
    bar: ProgressBar,
}

impl Terminal {
    pub(super) fn new() -> Self {
        let style = ProgressStyle::with_template(
            "{spinner} {prefix}{msg}  {wide_bar:.cyan/blue} {pos} of at most {len}  {elapsed}",
        )
        .unwrap_or_else(|_| ProgressStyle::default_bar());
        // indicatif hides the bar where stderr is not a terminal.
        let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
        bar.set_style(style);
        bar.set_message("preparing");
        bar.tick();
        Self {
            began: Instant::now(),
            bar,
        }
    }

    /// Sets the name of the current part of the work, shown before the bar's message.
    pub(super) fn part(&self, name: &str) {
        self.bar.set_prefix(format!("{name}, "));
    }

    /// Clears the bar.
    pub(super) fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

impl Control for Terminal {
    fn seconds(&self) -> f64 {
        self.began.elapsed().as_secs_f64()
    }

    fn progress(&self, progress: Progress) {
        self.bar.set_length(progress.total as u64);
        self.bar.set_position(progress.done as u64);
        self.bar.set_message(format!("loss {:.4}", progress.loss));
    }
}

/// A bar of a known length in indicatif's template, shown where stderr is a terminal.
pub(super) fn bar(length: u64, template: &str) -> ProgressBar {
    let style = ProgressStyle::with_template(template);
    let bar = ProgressBar::with_draw_target(Some(length), ProgressDrawTarget::stderr());
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}
