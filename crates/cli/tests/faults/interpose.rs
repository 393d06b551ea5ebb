//! A library between the program and the C library (`LD_PRELOAD`), which counts operations on files and makes one of
//! them fail. `faults.rs` compiles it with rustc. The program itself has no code for it.
//!
//! - `FAULT_ROOT`: operations below this folder count; a relative path is below it.
//! - `FAULT_COUNTS`: a file of [`SIZE`] bytes, which all processes share: a number of operations per class, and at
//!   [`NAME_AT`] the path of the operation that was made to fail.
//! - `FAULT`: `CLASS:N:ACTION`, such as `rename:17:5`: the 17th renaming fails with the error number 5. `N+` stands for
//!   this operation and all after it. The action `kill` ends the process before the operation. The action `short`
//!   writes or reads one byte.

use std::ffi::{CStr, c_char, c_int, c_uint, c_void};
use std::sync::atomic::{AtomicPtr, AtomicU64, AtomicUsize, Ordering};

/// Size of the shared file, bytes.
const SIZE: usize = 8192;
/// Where the path of the failed operation begins in the shared file.
const NAME_AT: usize = 4096;

/// The classes of operations. The last one counts those of all classes up to `lock`, which change something.
const CLASSES: [&str; 13] = [
    "create", "write", "rename", "sync", "mkdir", "remove", "truncate", "lock", "open", "read", "stat", "list",
    "change",
];
const CREATE: usize = 0;
const WRITE: usize = 1;
const RENAME: usize = 2;
const SYNC: usize = 3;
const MKDIR: usize = 4;
const REMOVE: usize = 5;
const TRUNCATE: usize = 6;
const LOCK: usize = 7;
const OPEN: usize = 8;
const READ: usize = 9;
const STAT: usize = 10;
const LIST: usize = 11;
const CHANGE: usize = 12;

const KILL: usize = 10_000;
const SHORT: usize = 10_001;

const AT_FDCWD: c_int = -100;
const O_CREAT: c_int = 0o100;

unsafe extern "C" {
    fn dlsym(handle: *mut c_void, name: *const c_char) -> *mut c_void;
    fn getenv(name: *const c_char) -> *const c_char;
    fn mmap(at: *mut c_void, length: usize, prot: c_int, flags: c_int, fd: c_int, offset: i64) -> *mut c_void;
    fn readlink(path: *const c_char, buffer: *mut c_char, size: usize) -> isize;
    fn __errno_location() -> *mut c_int;
    fn getpid() -> c_int;
    fn kill(pid: c_int, signal: c_int) -> c_int;
    fn pause() -> c_int;
}

/// The function that this library stands before.
macro_rules! next {
    ($name:expr, $type:ty) => {{
        static FOUND: AtomicUsize = AtomicUsize::new(0);
        let mut found = FOUND.load(Ordering::Relaxed);
        if found == 0 {
            found = unsafe { dlsym(-1isize as *mut c_void, concat!($name, "\0").as_ptr().cast()) } as usize;
            FOUND.store(found, Ordering::Relaxed);
        }
        unsafe { std::mem::transmute::<usize, $type>(found) }
    }};
}

/// What the environment asks for.
struct Plan {
    root: &'static [u8],
    class: usize,
    number: u64,
    and_after: bool,
    action: usize,
}

fn variable(name: &'static str) -> Option<&'static [u8]> {
    let found = unsafe { getenv(name.as_ptr().cast()) };
    (!found.is_null()).then(|| unsafe { CStr::from_ptr(found) }.to_bytes())
}

fn plan() -> Option<Plan> {
    let root = variable("FAULT_ROOT\0")?;
    let mut plan = Plan { root, class: usize::MAX, number: 0, and_after: false, action: 0 };
    let text = variable("FAULT\0").and_then(|text| std::str::from_utf8(text).ok()).unwrap_or_default();
    let mut parts = text.split(':');
    if let (Some(class), Some(number), Some(action)) = (parts.next(), parts.next(), parts.next()) {
        plan.class = CLASSES.iter().position(|name| *name == class)?;
        plan.and_after = number.ends_with('+');
        plan.number = number.trim_end_matches('+').parse().ok()?;
        plan.action = match action {
            "kill" => KILL,
            "short" => SHORT,
            errno => errno.parse().ok()?,
        };
    }
    Some(plan)
}

/// The shared counters.
fn counts() -> Option<&'static [AtomicU64]> {
    static MAPPED: AtomicPtr<c_void> = AtomicPtr::new(std::ptr::null_mut());
    let mut mapped = MAPPED.load(Ordering::Acquire);
    if mapped.is_null() {
        let path = variable("FAULT_COUNTS\0")?;
        let fd = next!("open64", extern "C" fn(*const c_char, c_int, c_uint) -> c_int)(path.as_ptr().cast(), 2, 0);
        mapped = unsafe { mmap(std::ptr::null_mut(), SIZE, 3, 1, fd, 0) };
        MAPPED.store(mapped, Ordering::Release);
    }
    (mapped as isize != -1).then(|| unsafe { std::slice::from_raw_parts(mapped.cast(), CLASSES.len()) })
}

/// The path of an open file.
fn path_of(fd: c_int, buffer: &mut [u8; 4096]) -> &[u8] {
    let mut name = *b"/proc/self/fd/\0\0\0\0\0\0\0\0\0\0\0\0";
    let (mut digits, mut rest) = ([0; 10], fd.max(0));
    let mut count = 0;
    while count == 0 || rest > 0 {
        digits[count] = b'0' + (rest % 10) as u8;
        rest /= 10;
        count += 1;
    }
    for i in 0..count {
        name[14 + i] = digits[count - 1 - i];
    }
    let length = unsafe { readlink(name.as_ptr().cast(), buffer.as_mut_ptr().cast(), buffer.len()) };
    &buffer[..length.max(0) as usize]
}

fn bytes_of<'a>(path: *const c_char) -> &'a [u8] {
    if path.is_null() { b"" } else { unsafe { CStr::from_ptr(path) }.to_bytes() }
}

/// Counts an operation on a path below the folder of descriptor `at`.
fn met_at(class: usize, at: c_int, path: *const c_char) -> Option<usize> {
    let path = bytes_of(path);
    if at == AT_FDCWD || path.starts_with(b"/") {
        return met(class, path);
    }
    met_fd(class, at)
}

/// Counts an operation on an open file.
fn met_fd(class: usize, fd: c_int) -> Option<usize> {
    let mut buffer = [0; 4096];
    let path = path_of(fd, &mut buffer);
    // Pipes and sockets have no path.
    if path.starts_with(b"/") { met(class, path) } else { None }
}

/// Counts an operation; its action if it has to fail.
fn met(class: usize, path: &[u8]) -> Option<usize> {
    let plan = plan()?;
    if path.is_empty() || path.starts_with(b"/") && !path.starts_with(plan.root) {
        return None;
    }
    let counts = counts()?;
    let mut hit = false;
    for of in [Some(class), (class <= LOCK).then_some(CHANGE)].into_iter().flatten() {
        let number = counts[of].fetch_add(1, Ordering::SeqCst) + 1;
        hit |= of == plan.class && (number == plan.number || plan.and_after && number > plan.number);
    }
    if !hit {
        return None;
    }
    let name = unsafe { counts.as_ptr().cast::<u8>().cast_mut().add(NAME_AT) };
    if unsafe { *name } == 0 {
        let length = path.len().min(SIZE - NAME_AT - 1);
        unsafe { std::ptr::copy_nonoverlapping(path.as_ptr(), name, length) };
    }
    if plan.action == KILL {
        unsafe {
            kill(getpid(), 9);
            loop {
                pause();
            }
        }
    }
    Some(plan.action)
}

fn fail(errno: usize) -> c_int {
    unsafe { *__errno_location() = errno as c_int };
    -1
}

/// A function on a path.
macro_rules! on_path {
    ($($name:ident($($arg:ident: $type:ty),*) -> $result:ty, $class:expr, $path:ident;)*) => {$(
        /// As the function of the C library.
        #[unsafe(no_mangle)]
        pub extern "C" fn $name($($arg: $type),*) -> $result {
            match met_at($class, AT_FDCWD, $path) {
                Some(errno) if errno != SHORT => fail(errno) as $result,
                _ => next!(stringify!($name), extern "C" fn($($type),*) -> $result)($($arg),*),
            }
        }
    )*};
}

/// A function on a path below an open folder.
macro_rules! on_path_at {
    ($($name:ident($($arg:ident: $type:ty),*), $class:expr, $at:ident, $path:ident;)*) => {$(
        /// As the function of the C library.
        #[unsafe(no_mangle)]
        pub extern "C" fn $name($($arg: $type),*) -> c_int {
            match met_at($class, $at, $path) {
                Some(errno) if errno != SHORT => fail(errno),
                _ => next!(stringify!($name), extern "C" fn($($type),*) -> c_int)($($arg),*),
            }
        }
    )*};
}

/// A function on an open file.
macro_rules! on_file {
    ($($name:ident($fd:ident: c_int $(, $arg:ident: $type:ty)*), $class:expr;)*) => {$(
        /// As the function of the C library.
        #[unsafe(no_mangle)]
        pub extern "C" fn $name($fd: c_int, $($arg: $type),*) -> c_int {
            match met_fd($class, $fd) {
                Some(errno) if errno != SHORT => fail(errno),
                _ => next!(stringify!($name), extern "C" fn(c_int, $($type),*) -> c_int)($fd, $($arg),*),
            }
        }
    )*};
}

/// A function that moves bytes; `short` makes it move one.
macro_rules! moves_bytes {
    ($($name:ident($fd:ident: c_int, $buffer:ident: *mut c_void, $size:ident: usize $(, $arg:ident: $type:ty)*), $class:expr;)*) => {$(
        /// As the function of the C library.
        #[unsafe(no_mangle)]
        pub extern "C" fn $name($fd: c_int, $buffer: *mut c_void, $size: usize $(, $arg: $type)*) -> isize {
            let size = match met_fd($class, $fd) {
                None => $size,
                Some(SHORT) => $size.min(1),
                Some(errno) => return fail(errno) as isize,
            };
            next!(stringify!($name), extern "C" fn(c_int, *mut c_void, usize $(, $type)*) -> isize)($fd, $buffer, size $(, $arg)*)
        }
    )*};
}

fn opening(flags: c_int) -> usize {
    if flags & O_CREAT != 0 { CREATE } else { OPEN }
}

on_path! {
    open(path: *const c_char, flags: c_int, mode: c_uint) -> c_int, opening(flags), path;
    open64(path: *const c_char, flags: c_int, mode: c_uint) -> c_int, opening(flags), path;
    rename(from: *const c_char, to: *const c_char) -> c_int, RENAME, to;
    link(from: *const c_char, to: *const c_char) -> c_int, RENAME, to;
    symlink(target: *const c_char, path: *const c_char) -> c_int, CREATE, path;
    mkdir(path: *const c_char, mode: c_uint) -> c_int, MKDIR, path;
    unlink(path: *const c_char) -> c_int, REMOVE, path;
    rmdir(path: *const c_char) -> c_int, REMOVE, path;
    stat64(path: *const c_char, to: *mut c_void) -> c_int, STAT, path;
    lstat64(path: *const c_char, to: *mut c_void) -> c_int, STAT, path;
}

on_path_at! {
    openat(at: c_int, path: *const c_char, flags: c_int, mode: c_uint), opening(flags), at, path;
    openat64(at: c_int, path: *const c_char, flags: c_int, mode: c_uint), opening(flags), at, path;
    renameat(from_at: c_int, from: *const c_char, to_at: c_int, to: *const c_char), RENAME, to_at, to;
    renameat2(from_at: c_int, from: *const c_char, to_at: c_int, to: *const c_char, flags: c_uint), RENAME, to_at, to;
    linkat(from_at: c_int, from: *const c_char, to_at: c_int, to: *const c_char, flags: c_int), RENAME, to_at, to;
    unlinkat(at: c_int, path: *const c_char, flags: c_int), REMOVE, at, path;
    mkdirat(at: c_int, path: *const c_char, mode: c_uint), MKDIR, at, path;
    statx(at: c_int, path: *const c_char, flags: c_int, mask: c_uint, to: *mut c_void), STAT, at, path;
}

on_file! {
    fsync(fd: c_int), SYNC;
    fdatasync(fd: c_int), SYNC;
    ftruncate(fd: c_int, size: i64), TRUNCATE;
    ftruncate64(fd: c_int, size: i64), TRUNCATE;
    flock(fd: c_int, operation: c_int), LOCK;
}

moves_bytes! {
    write(fd: c_int, buffer: *mut c_void, size: usize), WRITE;
    pwrite64(fd: c_int, buffer: *mut c_void, size: usize, offset: i64), WRITE;
    read(fd: c_int, buffer: *mut c_void, size: usize), READ;
    pread64(fd: c_int, buffer: *mut c_void, size: usize, offset: i64), READ;
}

/// As the function of the C library.
#[unsafe(no_mangle)]
pub extern "C" fn opendir(path: *const c_char) -> *mut c_void {
    match met_at(LIST, AT_FDCWD, path) {
        Some(errno) if errno != SHORT => {
            fail(errno);
            std::ptr::null_mut()
        }
        _ => next!("opendir", extern "C" fn(*const c_char) -> *mut c_void)(path),
    }
}

/// As the function of the C library. The standard library copies files with it.
#[unsafe(no_mangle)]
pub extern "C" fn copy_file_range(
    from: c_int,
    from_at: *mut i64,
    to: c_int,
    to_at: *mut i64,
    size: usize,
    flags: c_uint,
) -> isize {
    match met_fd(WRITE, to) {
        Some(errno) if errno != SHORT => fail(errno) as isize,
        _ => {
            type Copy = extern "C" fn(c_int, *mut i64, c_int, *mut i64, usize, c_uint) -> isize;
            next!("copy_file_range", Copy)(from, from_at, to, to_at, size, flags)
        }
    }
}
