{{/* What names the objects of a release. */}}
{{- define "fnsf.selector" -}}
app.kubernetes.io/name: fnsf
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end }}

{{- define "fnsf.labels" -}}
{{ include "fnsf.selector" . }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ .Chart.Name }}-{{ .Chart.Version }}
{{- end }}

{{- define "fnsf.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end }}

{{/* The annotations of a pod: its metrics are read from the admin port. */}}
{{- define "fnsf.annotations" -}}
prometheus.io/scrape: "true"
prometheus.io/port: "9090"
{{- end }}

{{/* The pod's own rights, and more time to stop than shutdown.timeout_seconds. */}}
{{- define "fnsf.pod" -}}
automountServiceAccountToken: false
securityContext:
  runAsNonRoot: true
  runAsUser: 65532
  runAsGroup: 65532
  fsGroup: 65532
  fsGroupChangePolicy: OnRootMismatch
  seccompProfile:
    type: RuntimeDefault
terminationGracePeriodSeconds: {{ .Values.gracePeriodSeconds }}
{{- end }}

{{- define "fnsf.probes" -}}
startupProbe:
  httpGet:
    path: /readyz
    port: admin
  failureThreshold: 60
  periodSeconds: 2
livenessProbe:
  httpGet:
    path: /livez
    port: admin
  periodSeconds: 10
readinessProbe:
  httpGet:
    path: /readyz
    port: admin
  periodSeconds: 2
{{- end }}

{{- define "fnsf.container" -}}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities:
    drop:
      - ALL
volumeMounts:
  - name: data
    mountPath: /data
{{- end }}
