{{/* The variables that all nodes have. */}}
{{- define "fnsf.settings" -}}
{{- $own := dict "FNSF_SERVE_STORAGE" .Values.storage "FNSF_SERVE_SHUTDOWN__READINESS_DELAY_SECONDS" "5" }}
{{- range $name, $value := merge (dict) .Values.settings .Values.storageSettings $own }}
{{ $name }}: {{ $value | quote }}
{{- end }}
{{- end }}

{{/* Pods are replaced when their variables change. */}}
{{- define "fnsf.fleet.annotations" -}}
{{ include "fnsf.annotations" . }}
checksum/settings: {{ include "fnsf.settings" . | sha256sum }}
{{- end }}

{{- define "fnsf.fleet.environment" -}}
envFrom:
  - secretRef:
      name: {{ .Values.secret }}
  - configMapRef:
      name: {{ .Release.Name }}
env:
  - name: FNSF_SERVE_NODE
    valueFrom:
      fieldRef:
        fieldPath: metadata.name
{{- end }}
