//! The messages of ONNX that the graphs need, with the numbers of `onnx.proto` (onnx.ai, IR version 8).
//!
//! The messages are written out by a macro with what `prost` has for generated code.

use prost::bytes::{Buf, BufMut};
use prost::encoding::{DecodeContext, WireType, bytes, int32, int64, message, skip_field, string};
use prost::{DecodeError, Message};

/// What is done with a field, by whether it may be missing or occurs several times.
macro_rules! field {
    (type optional $kind:ty) => { Option<$kind> };
    (type repeated $kind:ty) => { Vec<$kind> };
    (encode optional $codec:ident $field:expr, $tag:literal, $buf:expr) => {
        if let Some(value) = &$field {
            $codec::encode($tag, value, $buf);
        }
    };
    (encode repeated $codec:ident $field:expr, $tag:literal, $buf:expr) => {
        $codec::encode_repeated($tag, &$field, $buf)
    };
    (length optional $codec:ident $field:expr, $tag:literal) => {
        $field.as_ref().map_or(0, |value| $codec::encoded_len($tag, value))
    };
    (length repeated $codec:ident $field:expr, $tag:literal) => {
        $codec::encoded_len_repeated($tag, &$field)
    };
    (merge optional $codec:ident $field:expr, $wire:expr, $buf:expr, $context:expr) => {
        $codec::merge($wire, $field.get_or_insert_with(Default::default), $buf, $context)
    };
    (merge repeated $codec:ident $field:expr, $wire:expr, $buf:expr, $context:expr) => {
        $codec::merge_repeated($wire, &mut $field, $buf, $context)
    };
}

/// Declares a message: `field: optional|repeated codec Type = number,`.
macro_rules! message {
    ($(#[$of:meta])* $name:ident {
        $($(#[$of_field:meta])* $field:ident: $label:ident $codec:ident $kind:ty = $tag:literal,)+
    }) => {
        $(#[$of])*
        #[derive(Clone, Debug, Default, PartialEq)]
        pub struct $name {
            $($(#[$of_field])* pub $field: field!(type $label $kind),)+
        }

        impl Message for $name {
            fn encode_raw(&self, buf: &mut impl BufMut) {
                $(field!(encode $label $codec self.$field, $tag, buf);)+
            }

            fn merge_field(
                &mut self,
                tag: u32,
                wire: WireType,
                buf: &mut impl Buf,
                context: DecodeContext,
            ) -> Result<(), DecodeError> {
                match tag {
                    $($tag => field!(merge $label $codec self.$field, wire, buf, context),)+
                    _ => skip_field(wire, tag, buf, context),
                }
            }

            fn encoded_len(&self) -> usize {
                0 $(+ field!(length $label $codec self.$field, $tag))+
            }

            fn clear(&mut self) {
                *self = Self::default();
            }
        }
    };
}

/// Type of an attribute.
pub mod attribute_type {
    /// A whole number.
    pub const INT: i32 = 2;
    /// A list of whole numbers.
    pub const INTS: i32 = 7;
}

/// Type of the elements of a tensor.
pub mod element {
    /// 32-bit floats.
    pub const FLOAT: i32 = 1;
    /// 64-bit whole numbers.
    pub const INT64: i32 = 7;
}

message! {
    /// A model.
    ModelProto {
        /// Version of the format.
        ir_version: optional int64 i64 = 1,
        /// The program.
        producer_name: optional string String = 2,
        /// Its version.
        producer_version: optional string String = 3,
        /// What it is.
        doc_string: optional string String = 6,
        /// The graph.
        graph: optional message GraphProto = 7,
        /// Versions of the operators.
        opset_import: repeated message OperatorSetIdProto = 8,
    }
}

message! {
    /// A set of operators.
    OperatorSetIdProto {
        /// Empty for ONNX' own.
        domain: optional string String = 1,
        /// Its version.
        version: optional int64 i64 = 2,
    }
}

message! {
    /// Nodes in an order in which they can be executed.
    GraphProto {
        /// The nodes.
        node: repeated message NodeProto = 1,
        /// Name of the graph.
        name: optional string String = 2,
        /// Constants.
        initializer: repeated message TensorProto = 5,
        /// Inputs.
        input: repeated message ValueInfoProto = 11,
        /// Outputs.
        output: repeated message ValueInfoProto = 12,
    }
}

message! {
    /// An operation.
    NodeProto {
        /// Names of what it reads.
        input: repeated string String = 1,
        /// Names of what it writes.
        output: repeated string String = 2,
        /// Its name.
        name: optional string String = 3,
        /// The operator.
        op_type: optional string String = 4,
        /// Its constants.
        attribute: repeated message AttributeProto = 5,
    }
}

message! {
    /// A constant of an operation.
    AttributeProto {
        /// Its name.
        name: optional string String = 1,
        /// A whole number.
        i: optional int64 i64 = 3,
        /// Whole numbers.
        ints: repeated int64 i64 = 8,
        /// One of [`attribute_type`].
        kind: optional int32 i32 = 20,
    }
}

message! {
    /// A constant tensor.
    TensorProto {
        /// Its dimensions.
        dims: repeated int64 i64 = 1,
        /// One of [`element`].
        data_type: optional int32 i32 = 2,
        /// Its name.
        name: optional string String = 8,
        /// Its values, little-endian.
        raw_data: optional bytes Vec<u8> = 9,
    }
}

message! {
    /// An input or output.
    ValueInfoProto {
        /// Its name.
        name: optional string String = 1,
        /// Its type.
        r#type: optional message TypeProto = 2,
    }
}

message! {
    /// The type of a tensor.
    TypeProto {
        /// Of its elements and dimensions.
        tensor_type: optional message TensorTypeProto = 1,
    }
}

message! {
    /// Elements and dimensions.
    TensorTypeProto {
        /// One of [`element`].
        elem_type: optional int32 i32 = 1,
        /// Dimensions.
        shape: optional message TensorShapeProto = 2,
    }
}

message! {
    /// Dimensions.
    TensorShapeProto {
        /// Each of them.
        dim: repeated message DimensionProto = 1,
    }
}

message! {
    /// A dimension: a number or a name.
    DimensionProto {
        /// The number.
        dim_value: optional int64 i64 = 1,
        /// The name.
        dim_param: optional string String = 2,
    }
}
