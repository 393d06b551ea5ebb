//! Reader of Python's pickle format that builds plain values and calls nothing.
//!
//! A pickle is a program for a stack machine. Its values are stored in one list and refer to each other by index, so
//! that sharing and nesting need neither copies nor recursion. Calls of the names that [`Contents`] accepts become
//! inert values; any other name is refused. [`Contents`] limits the number of instructions and of values, and with them
//! the memory: to about 150 MB for a checkpoint, to about 1.2 GB for detections, and to about 100 n bytes for a file of
//! n bytes.

mod machine;

use machine::Machine;

/// Index of a value in its pickle.
pub type Id = u32;

/// One value.
#[derive(Clone, Debug, PartialEq)]
pub enum Value<'a> {
    /// `None`.
    None,
    /// `True` or `False`.
    Bool(bool),
    /// An integer.
    Int(i64),
    /// An integer beyond 64 bits, little-endian two's complement.
    Long(&'a [u8]),
    /// A floating point number.
    Float(f64),
    /// A string.
    Str(&'a str),
    /// Bytes, or an array of bytes.
    Bytes(&'a [u8]),
    /// A tuple.
    Tuple(Vec<Id>),
    /// A list.
    List(Vec<Id>),
    /// A `dict` or an `OrderedDict`, in the order of its entries.
    Dict(Vec<(Id, Id)>),
    /// An accepted name: module and name.
    Global(&'a str, &'a str),
    /// The call of a global with a tuple of arguments.
    Call {
        /// The global.
        callable: Id,
        /// A tuple.
        arguments: Id,
        /// The state that was set on its result, if any.
        state: Option<Id>,
    },
    /// A persistent id; here always a storage.
    Persistent(Id),
}

/// The values of one pickle.
pub struct Pickle<'a> {
    values: Vec<Value<'a>>,
    root: Id,
    /// Length of the pickle at the beginning of the input, bytes.
    pub length: usize,
}

/// What a pickle may contain: the names that it may call, and its size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Contents {
    /// A checkpoint of torch. One of PointRCNN with its optimiser has 25,000 instructions.
    Checkpoint,
    /// Lists, dictionaries and arrays of numpy, such as detections. A frame of OpenPCDet's `result.pkl` has about 100
    /// values.
    Arrays,
}

/// Names in a checkpoint: module and name. Tensors and dictionaries are interpreted; numpy scalars occur in the state
/// of OpenPCDet's optimiser and stay inert. Storages of `torch` are accepted in addition.
const OF_CHECKPOINT: &[(&str, &str)] = &[
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch._utils", "_rebuild_parameter"),
    ("collections", "OrderedDict"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
];

/// Names in a pickle of numpy arrays, of numpy 1 and 2 and of every protocol. [`crate::results`] interprets them.
const OF_ARRAYS: &[(&str, &str)] = &[
    ("collections", "OrderedDict"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
    ("__builtin__", "bytes"),
    ("builtins", "bytes"),
];

impl Contents {
    /// Whether a name may be called.
    fn accepts(self, module: &str, name: &str) -> bool {
        match self {
            Contents::Checkpoint => {
                module == "torch" && storage_width(name).is_some() || OF_CHECKPOINT.contains(&(module, name))
            }
            Contents::Arrays => OF_ARRAYS.contains(&(module, name)),
        }
    }

    /// What is in the file, for error messages.
    fn noun(self) -> &'static str {
        match self {
            Contents::Checkpoint => "a checkpoint of weights",
            Contents::Arrays => "a list of detections in numpy arrays",
        }
    }

    /// Maximum number of instructions.
    fn max_opcodes(self) -> usize {
        match self {
            Contents::Checkpoint => 1 << 21,
            Contents::Arrays => 1 << 28,
        }
    }

    /// Maximum number of values.
    fn max_values(self) -> usize {
        match self {
            Contents::Checkpoint => 1 << 21,
            Contents::Arrays => 1 << 24,
        }
    }
}

impl<'a> Pickle<'a> {
    /// Reads the pickle at the beginning of `bytes`.
    pub fn parse(bytes: &'a [u8], contents: Contents) -> Result<Self, String> {
        let (values, root, length) = Machine::run(bytes, contents)?;
        Ok(Pickle { values, root, length })
    }

    /// The root value.
    pub fn root(&self) -> &Value<'a> {
        self.get(self.root)
    }

    /// A value.
    pub fn get(&self, id: Id) -> &Value<'a> {
        &self.values[id as usize] // only `push` creates ids
    }

    /// Every value, in the order of creation.
    pub fn values(&self) -> &[Value<'a>] {
        &self.values
    }
}

/// Element size of a storage of torch, bytes.
pub fn storage_width(name: &str) -> Option<usize> {
    match name {
        "DoubleStorage" | "LongStorage" => Some(8),
        "FloatStorage" | "IntStorage" => Some(4),
        "HalfStorage" | "BFloat16Storage" | "ShortStorage" => Some(2),
        "CharStorage" | "ByteStorage" | "BoolStorage" => Some(1),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(bytes: &[u8]) -> String {
        Pickle::parse(bytes, Contents::Checkpoint).err().expect("should be refused")
    }

    #[test]
    fn plain_values() {
        let pickle = b"\x80\x02}q\x00(X\x01\x00\x00\x00aK\x05X\x01\x00\x00\x00b]q\x01(M\x00\x01h\x00eu.rest";
        let pickle = Pickle::parse(pickle, Contents::Checkpoint).unwrap();
        assert_eq!(pickle.length, 32);
        let Value::Dict(entries) = pickle.root() else { panic!() };
        assert_eq!(entries.len(), 2);
        assert_eq!((pickle.get(entries[0].0), pickle.get(entries[0].1)), (&Value::Str("a"), &Value::Int(5)));
        let Value::List(items) = pickle.get(entries[1].1) else { panic!() };
        assert_eq!(pickle.get(items[0]), &Value::Int(256));
        assert_eq!(pickle.get(items[1]), pickle.root(), "a value may contain itself");
    }

    #[test]
    fn whole_numbers() {
        for (bytes, want) in [
            (&b"\x8a\x00."[..], 0),
            (b"\x8a\x01\xff.", -1),
            (b"\x8a\x02\x00\x01.", 256),
            (b"\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7f.", i64::MAX),
            (b"J\xfe\xff\xff\xff.", -2),
        ] {
            assert_eq!(Pickle::parse(bytes, Contents::Checkpoint).unwrap().root(), &Value::Int(want));
        }
        let long = Pickle::parse(b"\x8a\x09\x00\x00\x00\x00\x00\x00\x00\x00\x01.", Contents::Checkpoint).unwrap();
        assert_eq!(long.root(), &Value::Long(&[0, 0, 0, 0, 0, 0, 0, 0, 1]));
    }

    #[test]
    fn code_is_refused_by_name() {
        for bytes in [
            &b"cos\nsystem\n(X\x02\x00\x00\x00lstR."[..],
            b"\x80\x04\x8c\x02os\x94\x8c\x06system\x94\x93.",
            b"cposix\nsystem\n.",
            b"cbuiltins\neval\n.",
            b"ctorch\nload\n.",
            b"ctorch._utils\nFloatStorage\n.",
        ] {
            assert!(error(bytes).contains("asks for "), "{}", error(bytes));
        }
        assert!(error(b"cos\nsystem\n.").contains("asks for os.system"));
        assert!(error(b"(ios\nsystem\n.").contains("instruction 0x69"));
        assert!(error(b"X\x02\x00\x00\x00ls)R.").contains("not accepted"));
    }

    #[test]
    fn broken_programs() {
        for bytes in [
            &b""[..],
            b".",
            b"N",
            b"NN.",
            b"(N.",
            b"t.",
            b"(Na.",
            b"]Nu.",
            b"}Ns.",
            b"}(Nu.",
            b"h\x00.",
            b"X\xff\xff\xff\xffabc.",
            b"X\x01\x00\x00\x00\xff.",
            b"ctorch",
            b"\x80\x09N.",
            b"N(0.",
            b"N}b.",
            b"N(b.",
        ] {
            error(bytes);
        }
        assert!(error(&[b'('; (1 << 21) + 5]).contains("more than"));
        // Deep nesting causes no recursion, neither in reading nor in dropping.
        let mut deep = vec![b']'; 1_000_000];
        deep.extend(vec![b'a'; 999_999]);
        deep.push(b'.');
        assert!(Pickle::parse(&deep, Contents::Checkpoint).is_ok());
    }
}
