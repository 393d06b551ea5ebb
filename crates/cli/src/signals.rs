//! SIGINT and SIGTERM. A training saves a checkpoint first; a second signal ends the program at once. Temporary files
//! and folders are removed. The program then ends by the signal itself, so that the exit status is the usual one.

use std::sync::atomic::{AtomicBool, AtomicI32, AtomicUsize, Ordering};
use train::Event;

/// Whether a training has to save a checkpoint and end.
static STOP: AtomicBool = AtomicBool::new(false);
/// The signal for which the program stops; 0 for a closed stdin.
static SIGNAL: AtomicI32 = AtomicI32::new(0);
/// Number of trainings that would save a checkpoint.
static TRAININGS: AtomicUsize = AtomicUsize::new(0);

/// A training that saves a checkpoint when the program has to stop, from its first to its last step. At other times the
/// program ends at once.
#[derive(Debug, Default)]
pub struct SaveFirst {
    /// Number of steps of the training, while it runs.
    total_steps: Option<u64>,
}

impl SaveFirst {
    /// Follows the events of the training.
    pub fn follow(&mut self, event: &Event<'_>) {
        match event {
            Event::Begin { state, .. } if self.total_steps.is_none() => {
                self.total_steps = Some(state.total_steps);
                TRAININGS.fetch_add(1, Ordering::SeqCst);
            }
            // The checkpoint of the last step is saved before this event.
            Event::Epoch(metrics) if self.total_steps == Some(metrics.step) => self.finish(),
            _ => {}
        }
    }

    fn finish(&mut self) {
        if self.total_steps.take().is_some() {
            TRAININGS.fetch_sub(1, Ordering::SeqCst);
            end_if_stopped();
        }
    }
}

impl Drop for SaveFirst {
    fn drop(&mut self) {
        if self.total_steps.take().is_some() {
            TRAININGS.fetch_sub(1, Ordering::SeqCst);
        }
    }
}

/// The flag for [`train::Session::stop`].
pub fn stop_flag() -> Option<&'static AtomicBool> {
    Some(&STOP)
}

/// Ends the program if a signal has asked for it, after a training has ended.
pub fn end_if_stopped() {
    if STOP.load(Ordering::SeqCst) {
        end(SIGNAL.load(Ordering::SeqCst));
    }
}

/// Stops the program as a signal does; 0 stands for no signal.
pub fn stop(signal: i32) {
    if TRAININGS.load(Ordering::SeqCst) > 0 && !STOP.load(Ordering::SeqCst) {
        SIGNAL.store(signal, Ordering::SeqCst);
        STOP.store(true, Ordering::SeqCst);
        crate::errln!("stopping: a checkpoint is saved first; a second signal ends the program at once");
        // The training may have ended before it could see the flag.
        if TRAININGS.load(Ordering::SeqCst) > 0 {
            return;
        }
    }
    end(signal);
}

/// Ends the process by a signal, or with exit code 1 for 0.
fn end(signal: i32) -> ! {
    data::output::remove_temporary();
    #[cfg(unix)]
    if signal != 0 {
        signal_hook::low_level::emulate_default_handler(signal).ok();
    }
    std::process::exit(if signal == 0 { 1 } else { 128 + signal })
}

/// Ends the process as by SIGPIPE.
pub fn end_by_pipe() -> ! {
    data::output::remove_temporary();
    #[cfg(unix)]
    signal_hook::low_level::emulate_default_handler(signal_hook::consts::SIGPIPE).ok();
    std::process::exit(141)
}

/// Handles SIGINT and SIGTERM from now on, unless the parent process made this one ignore them.
#[cfg(unix)]
pub fn handle() {
    use signal_hook::consts::{SIGINT, SIGTERM};
    let handled: Vec<i32> = [SIGINT, SIGTERM].into_iter().filter(|signal| !is_ignored(*signal)).collect();
    let Ok(mut signals) = signal_hook::iterator::Signals::new(handled) else { return };
    std::thread::spawn(move || signals.forever().for_each(stop));
}

/// Without signals nothing is handled.
#[cfg(not(unix))]
pub fn handle() {}

/// Whether a signal is ignored, as by `nohup` or for a command in the background of a script (Linux only).
#[cfg(unix)]
fn is_ignored(signal: i32) -> bool {
    let status = fs_err::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    let mask = mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0);
    mask >> (signal - 1) & 1 == 1
}
