//! Text on stdout and stderr. Writing never panics and never stops work.
//!
//! A command goes on if stdout is closed or full: its files are what matters. What the program could not print becomes
//! its exit status when the command has ended, see [`end`]. Errors of stderr are ignored. Control characters, which
//! names of files, classes and data sets may have, are escaped.

use std::borrow::Cow;
use std::ffi::OsString;
use std::fmt::Arguments;
use std::io::{Error, ErrorKind, Write as _};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// The first error of stdout.
static LOST: Mutex<Option<Error>> = Mutex::new(None);

/// Whether text goes to stderr, so that stdout has the JSON of `--json -` alone.
static TEXT_TO_STDERR: AtomicBool = AtomicBool::new(false);

/// Sends the text of [`print`] to stderr from now on.
pub(crate) fn text_to_stderr() {
    TEXT_TO_STDERR.store(true, Ordering::SeqCst);
}

/// Prints a line on stdout, as `println!` does.
#[macro_export]
macro_rules! outln {
    () => {
        $crate::console::print(format_args!("\n"))
    };
    ($($text:tt)*) => {
        $crate::console::print(format_args!("{}\n", format_args!($($text)*)))
    };
}

/// Prints text on stdout, as `print!` does.
#[macro_export]
macro_rules! out {
    ($($text:tt)*) => {
        $crate::console::print(format_args!($($text)*))
    };
}

/// Prints a line on stderr, as `eprintln!` does.
#[macro_export]
macro_rules! errln {
    ($($text:tt)*) => {
        $crate::console::print_error(format_args!("{}\n", format_args!($($text)*)))
    };
}

/// Prints text on stdout, or on stderr if stdout is for JSON. Nothing is printed after the first error of stdout.
pub fn print(text: Arguments<'_>) {
    if TEXT_TO_STDERR.load(Ordering::SeqCst) {
        print_error(text);
    } else {
        write_stdout(&escaped(&text.to_string()));
    }
}

/// Prints JSON on stdout, with a line feed behind it.
pub fn print_json(json: &str) {
    write_stdout(&format!("{}\n", escaped_json(json)));
}

fn write_stdout(text: &str) {
    let mut lost = lost();
    if lost.is_none() {
        let mut stdout = std::io::stdout().lock();
        *lost = stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()).err();
    }
}

/// Prints text on stderr. An error is ignored, since there is no place to report it.
pub fn print_error(text: Arguments<'_>) {
    let text = text.to_string();
    std::io::stderr().lock().write_all(escaped(&text).as_bytes()).ok();
}

/// Prints an error or a help text of the command line parser; returns its exit code.
pub fn print_usage(error: &clap::Error, arguments: &[OsString]) -> u8 {
    // The parser's own colours are control characters, so only text with other ones loses its colours.
    let strange = |argument: &OsString| matches!(escaped(&argument.to_string_lossy()), Cow::Owned(_));
    if !arguments.iter().any(strange) {
        let failed = error.print().err();
        if !error.use_stderr() {
            *lost() = failed;
        }
    } else if error.use_stderr() {
        print_error(format_args!("{error}"));
    } else {
        print(format_args!("{error}"));
    }
    u8::try_from(error.exit_code()).unwrap_or(2)
}

/// The exit code of a program after its last output: 1 with a message if stdout could not be written, else this code.
pub fn end(code: u8) -> u8 {
    lost_stdout().map_or(code, |error| {
        print_error(format_args!("error: stdout cannot be written: {error}\n"));
        crate::FAILURE
    })
}

/// Why stdout could not be written, if it could not. If it is a pipe that was closed, the program ends as by SIGPIPE.
pub(crate) fn lost_stdout() -> Option<Error> {
    let lost = lost().take();
    lost.inspect(|error| {
        if error.kind() == ErrorKind::BrokenPipe {
            crate::signals::end_by_pipe();
        }
    })
}

/// The text with all control characters but line feed and tab written as `\u{1b}`, and with those that change the
/// direction of text.
pub fn escaped(text: &str) -> Cow<'_, str> {
    if !text.contains(is_strange) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        if is_strange(c) { shown.extend(c.escape_unicode()) } else { shown.push(c) }
    }
    Cow::Owned(shown)
}

/// JSON with the same characters escaped as JSON does. They stand in strings alone.
pub fn escaped_json(text: &str) -> Cow<'_, str> {
    if !text.contains(is_strange) {
        return Cow::Borrowed(text);
    }
    let mut shown = String::with_capacity(text.len() + 8);
    for c in text.chars() {
        if is_strange(c) { shown += &format!("\\u{:04x}", u32::from(c)) } else { shown.push(c) }
    }
    Cow::Owned(shown)
}

/// Control characters other than line feed and tab, and those that change the direction of text.
fn is_strange(c: char) -> bool {
    c.is_control() && !matches!(c, '\n' | '\t') || matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

fn lost() -> std::sync::MutexGuard<'static, Option<Error>> {
    LOST.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_escaped() {
        for (text, want) in [
            ("plain\ttext\n", "plain\ttext\n"),
            ("a\u{1b}[31mb", "a\\u{1b}[31mb"),
            ("\r\u{7}\u{9b}", "\\u{d}\\u{7}\\u{9b}"),
            ("a\u{202e}b", "a\\u{202e}b"),
            ("Größe 点", "Größe 点"),
        ] {
            assert_eq!(escaped(text), want);
        }
    }
}
