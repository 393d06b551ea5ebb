//! `cargo xtask fuzz`: tests all file readers with damaged files. A reader must return valid data or an error. It must
//! not panic, hang, or allocate far more memory than the file size justifies.

mod recordings;
mod scenes;
mod shards;
mod targets;

use anyhow::{Result, bail};
use clap::Args;
use data::stream;
use indicatif::{ProgressBar, ProgressStyle};
use lidarshift::{errln, outln};
use rand::RngExt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;
use targets::{Target, targets};
use train::memory::{peak_mib, reset_peak_mib};

/// Limit of the additional memory of a reader. The files have a few kilobytes; a reader that exceeds it trusts a size
/// in the file without a check.
const MEMORY_BOUND_MIB: u64 = 64;
/// The same for rigs, which describe up to 16 million shots by a few numbers.
const RIG_BOUND_MIB: u64 = 600;
/// Limit of the time that a reader may take for one file.
const TIME_LIMIT: Duration = Duration::from_secs(30);

/// Test all file readers with damaged files: no panic, no hang, no excessive memory, no invalid data.
#[derive(Args, Debug)]
pub struct FuzzArgs {
    /// Number of damaged inputs per reader
    #[arg(long, default_value_t = 1000)]
    inputs: u64,
    /// Random seed of the damage
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Only readers whose name contains this text
    #[arg(long, default_value = "", hide_default_value = true)]
    only: String,
}

impl FuzzArgs {
    /// Runs the test; `true` if no reader failed.
    pub fn run(self) -> Result<bool> {
        // In memory if possible, since the readers of run folders write millions of files.
        let folder = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir())?;
        let mut stood = true;
        let hook = std::panic::take_hook();
        std::panic::set_hook(Box::new(|_| {}));
        let mut targets = targets(folder.path())?;
        let names: Vec<_> = targets.iter().map(|t| t.name).collect();
        targets.retain(|t| t.name.contains(&self.only));
        if targets.is_empty() {
            bail!("no reader's name contains {:?}: {}", self.only, names.join(", "));
        }
        for target in &targets {
            let found = self.test(target)?;
            let memory = found.peak_mib.map_or("unknown".into(), |mib| format!("{mib} MiB"));
            outln!(
                "{:<18} {} inputs, {} accepted, {} broken, memory {memory}",
                target.name,
                self.inputs,
                found.taken,
                found.broken.len()
            );
            found.broken.iter().take(5).for_each(|b| outln!("    {b}"));
            stood &= found.broken.is_empty();
        }
        std::panic::set_hook(hook);
        Ok(stood)
    }

    fn test(&self, target: &Target) -> Result<Found> {
        let bar = ProgressBar::new(self.inputs)
            .with_style(ProgressStyle::with_template("{msg} {bar:30} {pos}/{len}, {eta} left")?)
            .with_message(target.name);
        let watched = Watch::begin(target.name);
        let before = reset_peak_mib();
        let mut found = Found::default();
        for input in 0..self.inputs {
            let bytes = damaged(&target.valid, self.seed, target.name, input);
            watched.input(input);
            match catch_unwind(AssertUnwindSafe(|| (target.read)(&bytes))) {
                Ok(Ok(was_taken)) => found.taken += u64::from(was_taken),
                Ok(Err(promise)) => found.broken.push(format!("input {input}: {promise}")),
                Err(_) => found.broken.push(format!("input {input}: panic")),
            }
            if input % 1024 == 0 {
                bar.set_position(input);
            }
        }
        bar.finish_and_clear();
        found.peak_mib = before.and_then(|before| Some(peak_mib()?.saturating_sub(before)));
        let bound = if target.name.starts_with("rig") { RIG_BOUND_MIB } else { MEMORY_BOUND_MIB };
        if let Some(mib) = found.peak_mib.filter(|&mib| mib > bound) {
            found.broken.push(format!("took {mib} MiB, more than {bound}"));
        }
        Ok(found)
    }
}

/// Results of a reader.
#[derive(Default)]
struct Found {
    taken: u64,
    broken: Vec<String>,
    /// Memory in addition to what was in use before; `None` if the system does not report it.
    peak_mib: Option<u64>,
}

/// Ends the program if a reader exceeds the time limit.
struct Watch {
    input: Arc<AtomicU64>,
}

impl Watch {
    const OVER: u64 = u64::MAX;

    fn begin(name: &'static str) -> Self {
        let input = Arc::new(AtomicU64::new(0));
        let seen = input.clone();
        std::thread::spawn(move || {
            let mut last = 0;
            loop {
                std::thread::sleep(TIME_LIMIT);
                match seen.load(Ordering::Relaxed) {
                    Watch::OVER => return,
                    now if now == last && now > 0 => {
                        errln!("error: {name}: input {now} takes more than {} s", TIME_LIMIT.as_secs());
                        std::process::exit(1);
                    }
                    now => last = now,
                }
            }
        });
        Watch { input }
    }

    fn input(&self, input: u64) {
        self.input.store(input + 1, Ordering::Relaxed);
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.input.store(Watch::OVER, Ordering::Relaxed);
    }
}

/// Applies one to four random changes: a flipped bit, a changed byte, a cut, a repeated piece, a swapped piece.
fn damaged(valid: &[u8], seed: u64, name: &str, input: u64) -> Vec<u8> {
    let mut random = stream(seed, &format!("fuzz/{name}"), 0, input);
    let mut bytes = valid.to_vec();
    for _ in 0..random.random_range(1..=4) {
        if bytes.is_empty() {
            break;
        }
        let at = random.random_range(0..bytes.len());
        let until = (at + random.random_range(1..=16)).min(bytes.len());
        match random.random_range(0..6) {
            0 => bytes[at] ^= 1 << random.random_range(0..8),
            1 => bytes[at] = random.random(),
            2 => bytes.truncate(at),
            3 => drop(bytes.drain(at..until)),
            4 => {
                let piece = bytes[at..until].to_vec();
                let to = random.random_range(0..=bytes.len());
                bytes.splice(to..to, piece);
            }
            _ => {
                const NUMBERS: [&[u8]; 6] = [b"-1", b"nan", b"inf", b"99999999999999999999", b"0", b"\xff\xff\xff\xff"];
                let number = NUMBERS[random.random_range(0..NUMBERS.len())];
                bytes.splice(at..until, number.iter().copied());
            }
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn valid_files_are_accepted() {
        let folder = tempfile::tempdir().unwrap();
        for target in targets(folder.path()).unwrap() {
            assert_eq!((target.read)(&target.valid), Ok(true), "{}", target.name);
        }
    }

    #[test]
    fn a_failing_reader_is_found() {
        let panics: Target = Target { name: "panics", valid: vec![7; 40], read: Box::new(|bytes| Ok(bytes[39] == 7)) };
        let fuzz = FuzzArgs { inputs: 50, seed: 1, only: String::new() };
        assert!(fuzz.test(&panics).unwrap().broken.iter().any(|b| b.contains("panic")));
        let greedy = |_: &[u8]| Ok(std::hint::black_box(vec![1u8; 200 << 20]).len() > 7);
        let fuzz = FuzzArgs { inputs: 2, ..fuzz };
        let broken = fuzz.test(&Target { name: "greedy", valid: vec![7; 40], read: Box::new(greedy) }).unwrap().broken;
        assert_eq!(broken.iter().any(|b| b.contains("MiB")), cfg!(target_os = "linux"));
    }
}
