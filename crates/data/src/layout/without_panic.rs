//! Calls of libraries that panic on some damaged input.

use std::cell::Cell;
use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind, set_hook, take_hook};
use std::sync::Once;

thread_local! {
    /// Whether a panic of this thread is caught here.
    static IS_CAUGHT: Cell<bool> = const { Cell::new(false) };
}

/// What a library gives, or says against it. A panic is an error that names the `library`; nothing is printed of it.
///
/// What `work` has changed is not used again after an error.
pub(super) fn without_panic<T, E: Display>(library: &str, work: impl FnOnce() -> Result<T, E>) -> Result<T, String> {
    leave_caught_panics_unprinted();
    let before = IS_CAUGHT.replace(true);
    let result = catch_unwind(AssertUnwindSafe(|| work().map_err(|e| e.to_string())));
    IS_CAUGHT.set(before);
    result.unwrap_or_else(|_| Err(format!("its library ({library}) panicked")))
}

/// Puts a hook before the one that prints panics. It is asked in the thread that panics.
fn leave_caught_panics_unprinted() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let print = take_hook();
        set_hook(Box::new(move |panic| {
            if !IS_CAUGHT.get() {
                print(panic);
            }
        }));
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_an_error() {
        assert_eq!(without_panic("one", || Ok::<_, String>(7)), Ok(7));
        assert_eq!(without_panic("one", || Err::<(), _>("no")), Err("no".into()));
        let panicked = without_panic("one", || -> Result<(), String> { panic!("not printed") });
        assert_eq!(panicked, Err("its library (one) panicked".into()));
        assert!(!IS_CAUGHT.get());
    }
}
