//! OpenMetrics text as Prometheus' classic text, which knows no exemplars, no `info` and names
//! counters with their suffix. It must not know any single metric.

/// The classic form of an OpenMetrics page.
pub(super) fn classic(openmetrics: &str) -> String {
    let mut out = String::with_capacity(openmetrics.len());
    let mut suffix = "";
    for line in openmetrics.lines() {
        if line == "# EOF" || line.starts_with("# UNIT ") {
            continue;
        }
        if let Some(rest) = line.strip_prefix("# HELP ") {
            let (name, help) = rest.split_once(' ').unwrap_or((rest, ""));
            suffix = suffix_of(openmetrics, name);
            out.push_str(&format!("# HELP {name}{suffix} {help}\n"));
        } else if let Some(rest) = line.strip_prefix("# TYPE ") {
            let (name, kind) = rest.split_once(' ').unwrap_or((rest, "untyped"));
            let kind = if kind == "info" { "gauge" } else { kind };
            out.push_str(&format!("# TYPE {name}{suffix} {kind}\n"));
        } else {
            let end = line.find(" # ").unwrap_or(line.len());
            out.push_str(&line[..end]);
            out.push('\n');
        }
    }
    out
}

/// What OpenMetrics adds to the name of a metric's samples, by its type.
fn suffix_of(openmetrics: &str, name: &str) -> &'static str {
    let is = |kind: &str| openmetrics.contains(&format!("# TYPE {name} {kind}\n"));
    if is("counter") {
        "_total"
    } else if is("info") {
        "_info"
    } else {
        ""
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_get_their_suffix_and_exemplars_and_units_go() {
        let page = "# HELP a_jobs Jobs.\n# TYPE a_jobs counter\na_jobs_total{k=\"v\"} 1 # {id=\"x\"} 1\n\
                    # HELP b Build.\n# TYPE b info\nb_info{v=\"1\"} 1\n\
                    # HELP c_seconds Time.\n# TYPE c_seconds histogram\n# UNIT c_seconds seconds\n\
                    c_seconds_count 3\n# EOF\n";
        let expected = "# HELP a_jobs_total Jobs.\n# TYPE a_jobs_total counter\na_jobs_total{k=\"v\"} 1\n\
                        # HELP b_info Build.\n# TYPE b_info gauge\nb_info{v=\"1\"} 1\n\
                        # HELP c_seconds Time.\n# TYPE c_seconds histogram\nc_seconds_count 3\n";
        assert_eq!(classic(page), expected);
    }
}
