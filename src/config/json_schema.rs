//! The JSON Schema of the configuration file, for editors: from the types, their comments and the ranges.

use super::Config;
use super::ranges::RANGES;
use schemars::generate::SchemaSettings;
use serde_json::{Value, json};

/// The schema, as the file `config/beltgauge.schema.json`.
pub fn json_schema() -> String {
    let settings = SchemaSettings::draft07().with(|settings| settings.inline_subschemas = true);
    let schema = settings.into_generator().into_root_schema_for::<Config>();
    let mut schema = Value::from(schema);
    schema["title"] = json!("beltgauge.toml");
    without_null(&mut schema);
    for &(key, min, max, unit) in RANGES {
        let path = format!("/properties/{}", key.replace('.', "/properties/"));
        let Some(Value::Object(property)) = schema.pointer_mut(&path) else { continue };
        let is_integer = property.get("type") == Some(&json!("integer"));
        let number = |value: f64| if is_integer { json!(value as i64) } else { json!(value) };
        property.insert("minimum".into(), number(min));
        property.insert("maximum".into(), number(max));
        if !unit.is_empty()
            && let Some(Value::String(text)) = property.get_mut("description")
        {
            text.extend([" Unit: ", unit, "."]);
        }
    }
    // A map of strings and numbers always prints.
    serde_json::to_string_pretty(&schema).unwrap_or_default() + "\n"
}

/// TOML has no null: a key that may be left out is simply not required.
fn without_null(schema: &mut Value) {
    match schema {
        Value::Object(parts) => {
            if let Some(Value::Array(types)) = parts.get_mut("type") {
                types.retain(|kind| kind != "null");
                if let [only] = &types[..] {
                    let only = only.clone();
                    parts.insert("type".into(), only);
                }
            }
            parts.retain(|_, part| !part.is_null());
            // How wide a number is in this program is of no use to an editor.
            parts.remove("format");
            parts.values_mut().for_each(without_null);
        }
        Value::Array(parts) => parts.iter_mut().for_each(without_null),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn schema() -> Value {
        serde_json::from_str(&json_schema()).expect("JSON")
    }

    #[test]
    fn every_number_has_the_range_of_the_check() {
        let schema = schema();
        for (key, min, max, _) in RANGES {
            let path = format!("/properties/{}", key.replace('.', "/properties/"));
            let property = schema.pointer(&path).unwrap_or_else(|| panic!("{key} is no key"));
            let number = |name: &str| property[name].as_f64();
            assert_eq!((number("minimum"), number("maximum")), (Some(*min), Some(*max)), "{key}");
        }
        // And there is none without.
        let tables = schema["properties"].as_object().expect("tables");
        for (table, key, property) in tables.iter().flat_map(|(table, of)| {
            let keys = of["properties"].as_object().into_iter().flatten();
            keys.map(move |(key, property)| (table, key, property))
        }) {
            let is_number = ["number", "integer"].iter().any(|kind| property["type"] == *kind);
            let free = table == "encoder" && key == "mm_per_count";
            assert!(
                !is_number || free || property["maximum"].is_number(),
                "{table}.{key}: {property}"
            );
        }
    }

    #[test]
    fn unknown_keys_are_refused_and_defaults_are_shown() {
        let schema = schema();
        assert_eq!(schema["additionalProperties"], json!(false));
        assert_eq!(schema["required"], json!(["camera", "zone", "belt"]));
        let tracks = schema.pointer("/properties/limits/properties/tracks_max").expect("a key");
        assert_eq!((&tracks["default"], &tracks["type"]), (&json!(16), &json!("integer")));
        assert!(!json_schema().contains("null"), "TOML has none");
    }
}
