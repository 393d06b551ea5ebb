//! Prefetching: computes results on worker threads ahead of their consumer, in order and with bounded memory.

use std::any::Any;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Iterates over the results of `make` for `jobs`, in the order of the jobs for any number of workers.
///
/// At most `max(depth, 1)` results are computed or being computed but not taken. Without workers each result is
/// computed in [`Iterator::next`]. A panic in `make` is resumed in the consumer at the position of that job. Dropping
/// the iterator stops the workers after their current jobs.
pub fn prefetch<J, T, F>(jobs: Vec<J>, workers: usize, depth: usize, make: F) -> Prefetch<T>
where
    J: Send + Sync + 'static,
    T: Send + 'static,
    F: Fn(&J) -> T + Send + Sync + 'static,
{
    prefetch_numbered(jobs.len(), workers, depth, move |i| make(&jobs[i]))
}

/// As [`prefetch`], for the jobs from 0 to `total`, which are not listed.
pub fn prefetch_numbered<T, F>(total: usize, workers: usize, depth: usize, make: F) -> Prefetch<T>
where
    T: Send + 'static,
    F: Fn(usize) -> T + Send + Sync + 'static,
{
    let make = Arc::new(make);
    let shared = Arc::new(Shared { state: Mutex::default(), changed: Condvar::new() });
    let worker = || {
        let (shared, make) = (shared.clone(), make.clone());
        std::thread::spawn(move || shared.work(total, depth.max(1), &*make))
    };
    let threads = (0..workers.min(total)).map(|_| worker()).collect();
    Prefetch { total, make, shared, threads, waited: Duration::ZERO }
}

type Outcome<T> = Result<T, Box<dyn Any + Send>>;

/// The iterator of [`prefetch`].
pub struct Prefetch<T> {
    total: usize,
    make: Arc<dyn Fn(usize) -> T + Send + Sync>,
    shared: Arc<Shared<T>>,
    threads: Vec<JoinHandle<()>>,
    waited: Duration,
}

struct Shared<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
}

struct State<T> {
    /// Index of the next job to begin.
    next: usize,
    /// Number of results taken by the consumer.
    taken: usize,
    /// Results not yet taken, by the index of their job.
    ready: BTreeMap<usize, Outcome<T>>,
    stopped: bool,
}

impl<T> Default for State<T> {
    fn default() -> Self {
        State { next: 0, taken: 0, ready: BTreeMap::new(), stopped: false }
    }
}

impl<T> Shared<T> {
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().expect("no panic happens while the lock is held")
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State<T>>) -> MutexGuard<'a, State<T>> {
        self.changed.wait(state).expect("no panic happens while the lock is held")
    }

    fn work(&self, total: usize, depth: usize, make: &(dyn Fn(usize) -> T + Send + Sync)) {
        loop {
            let mut state = self.lock();
            while !state.stopped && state.next < total && state.next >= state.taken + depth {
                state = self.wait(state);
            }
            if state.stopped || state.next >= total {
                return;
            }
            let job = state.next;
            state.next += 1;
            drop(state);
            let outcome = catch_unwind(AssertUnwindSafe(|| make(job)));
            self.lock().ready.insert(job, outcome);
            self.changed.notify_all();
        }
    }
}

impl<T> Prefetch<T> {
    /// Total time for which the consumer has waited for results.
    pub fn waited(&self) -> Duration {
        self.waited
    }
}

impl<T> Iterator for Prefetch<T> {
    type Item = T;

    fn next(&mut self) -> Option<T> {
        let begin = Instant::now();
        let mut state = self.shared.lock();
        let job = state.taken;
        if job >= self.total {
            return None;
        }
        let outcome = if self.threads.is_empty() {
            state.taken += 1;
            drop(state);
            Ok((self.make)(job))
        } else {
            let outcome = loop {
                match state.ready.remove(&job) {
                    Some(outcome) => break outcome,
                    None => state = self.shared.wait(state),
                }
            };
            state.taken += 1;
            drop(state);
            self.shared.changed.notify_all();
            outcome
        };
        self.waited += begin.elapsed();
        Some(outcome.unwrap_or_else(|panic| resume_unwind(panic)))
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = self.total - self.shared.lock().taken;
        (left, Some(left))
    }
}

impl<T> ExactSizeIterator for Prefetch<T> {}

impl<T> Drop for Prefetch<T> {
    fn drop(&mut self) {
        self.shared.lock().stopped = true;
        self.shared.changed.notify_all();
        for thread in self.threads.drain(..) {
            // Workers catch panics of their jobs, so `join` has no error to report.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[test]
    fn the_same_results_in_order_for_any_number_of_workers() {
        let jobs: Vec<u64> = (0..200).collect();
        let make = |job: &u64| {
            let mut rng = crate::stream(7, "job", 0, *job);
            std::thread::sleep(Duration::from_micros(rng.random_range(0..200)));
            (*job, rng.random::<u64>())
        };
        let want: Vec<_> = jobs.iter().map(make).collect();
        for (workers, depth) in [(0, 0), (1, 0), (1, 1), (2, 3), (4, 16), (16, 2), (3, 1000)] {
            let mut results = prefetch(jobs.clone(), workers, depth, make);
            assert_eq!(results.len(), 200);
            assert!(results.by_ref().eq(want.iter().copied()), "{workers} workers");
            assert!(results.next().is_none());
        }
        assert_eq!(prefetch(Vec::<u64>::new(), 4, 4, make).count(), 0);
    }

    #[test]
    fn at_most_depth_results_are_computed_ahead() {
        let made = Arc::new(AtomicUsize::new(0));
        let count = made.clone();
        let results = prefetch((0..100).collect(), 8, 5, move |_: &usize| count.fetch_add(1, Ordering::SeqCst));
        for (taken, _) in results.enumerate() {
            assert!(made.load(Ordering::SeqCst) <= taken + 1 + 5);
        }
    }

    #[test]
    fn a_panic_is_resumed_at_the_position_of_its_job() {
        for workers in [0, 3] {
            let mut results = prefetch((0..10).collect(), workers, 4, |job: &i32| {
                assert!(*job != 2, "frame {job} is bad");
                *job
            });
            assert_eq!((results.next(), results.next()), (Some(0), Some(1)));
            let panic = catch_unwind(AssertUnwindSafe(|| results.next())).unwrap_err();
            assert!(panic.downcast_ref::<String>().unwrap().contains("frame 2 is bad"));
        }
    }

    #[test]
    fn dropping_the_iterator_stops_the_workers() {
        let alive = Arc::new(());
        let inside = alive.clone();
        let mut results = prefetch((0..1000).collect(), 4, 4, move |job: &i32| {
            let _ = &inside;
            *job
        });
        assert_eq!(results.next(), Some(0));
        drop(results);
        assert_eq!(Arc::strong_count(&alive), 1);
    }
}
